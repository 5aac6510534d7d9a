"""Cameras and the z-buffer: against a ray caster written from the equation, and against each other."""

import numpy as np
import pytest

from ddakf.errors import InvalidArgument
from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.files.depth import Intrinsics as Lens
from ddakf.kernels import zbuffer

LENS = Lens(20.0, 21.0, 11.5, 8.0)
INTRINSICS = Intrinsics(width=24, height=18, fx=20.0, fy=21.0, cx=11.5, cy=8.0)


def _ray_cast(vertices, faces):
    """Depth and face per pixel by intersecting every ray with every triangle (Cramer's rule)."""
    depth = np.full((INTRINSICS.height, INTRINSICS.width), np.inf)
    face = np.full(depth.shape, -1)
    for v, u in np.ndindex(depth.shape):
        ray = np.array([(u - INTRINSICS.cx) / INTRINSICS.fx, (v - INTRINSICS.cy) / INTRINSICS.fy, 1.0])
        for f, (a, b, c) in enumerate(vertices[faces]):
            system = np.column_stack([a - b, a - c, ray])
            if abs(np.linalg.det(system)) > 1e-12:
                beta, gamma, z = np.linalg.solve(system, a)
                if beta >= 0 and gamma >= 0 and beta + gamma <= 1 and 0 < z < depth[v, u]:
                    depth[v, u], face[v, u] = z, f
    return depth, face


def test_rasteriser_agrees_with_ray_casting():
    rng = np.random.default_rng(0)
    vertices = rng.uniform([-1, -1, 1], [1, 1, 3], (24, 3))
    faces = rng.permutation(24).reshape(8, 3)
    faces = np.concatenate([faces, [[0, 0, 1], [2, 2, 2]]])  # degenerate faces draw nothing
    depth, face = np.full((18, 24), np.inf), np.full((18, 24), -1, np.int32)
    zbuffer.rasterize(vertices, faces, LENS, 0, depth, face)
    expected_depth, expected_face = _ray_cast(vertices, faces)
    assert np.array_equal(face, expected_face)
    assert np.allclose(depth, expected_depth, rtol=1e-12)
    assert (face >= 0).mean() > 0.2


def test_faces_at_or_behind_the_camera_and_far_outside_draw_nothing():
    depth, face = np.full((18, 24), np.inf), np.full((18, 24), -1, np.int32)
    vertices = np.array([[0, 0, -1], [1, 0, 1], [0, 1, 1], [1e9, 0, 1], [2e9, 1, 1], [1e9, 3, 1]], float)
    zbuffer.rasterize(vertices, np.array([[0, 1, 2], [3, 4, 5]]), LENS, 0, depth, face)
    assert (face == -1).all()


@pytest.mark.parametrize("spread", [0.05, 0.4, 3.0, 1e6], ids=["small", "middling", "torn", "far out"])
def test_silhouettes_are_the_pixels_that_are_drawn(spread):
    rng = np.random.default_rng(5)
    camera = Camera.looking_at(Intrinsics(width=96, height=72, fx=80.0, fy=84.0, cx=47.5, cy=36.0), [0, 0, 4], [0, 0, 0])
    drawn = 0
    for _ in range(50):
        vertices = rng.uniform(-1, 1, (1, 3)) + spread * rng.normal(size=(30, 3))
        faces = rng.integers(0, 30, (rng.integers(1, 40), 3))
        depth, _ = camera.render([(vertices, faces)])
        assert np.array_equal(camera.silhouette(vertices, faces), np.isfinite(depth))
        drawn += np.isfinite(depth).sum()
    assert drawn > 100


def test_nearer_meshes_hide_farther_ones_in_any_order():
    quad = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    camera = Camera.looking_at(INTRINSICS, [0, 0, 4], [0, 0, 0])
    near, far = (quad * 0.3 + [0, 0, 1], faces), (quad, faces)
    depth, face = camera.render([near, far])
    swapped_depth, swapped_face = camera.render([far, near])
    assert np.array_equal(depth, swapped_depth)
    assert np.array_equal(face // 2 == 0, swapped_face // 2 == 1)
    assert depth[8, 11] == pytest.approx(3)
    assert {*np.unique(face)} == {-1, 0, 1, 2, 3}


def test_unprojected_pixels_lie_on_the_surface_and_project_back():
    quad = np.array([[-1, -1, 0], [1, -1, 0.3], [1, 1, 0], [-1, 1, -0.3]], float)
    camera = Camera.looking_at(INTRINSICS, [0.5, 1, 4], [0, 0.1, 0])
    depth, face = camera.render([(quad, np.array([[0, 1, 2]]))])
    points = camera.unproject(depth)
    normal = np.cross(quad[1] - quad[0], quad[2] - quad[0])
    assert np.allclose((points - quad[0]) @ normal, 0, atol=1e-12)
    assert np.allclose(camera.project(points), np.argwhere(face >= 0)[:, ::-1])


@pytest.mark.parametrize("height", [3.0, -3.0])
def test_a_camera_may_look_straight_down_or_up(height):
    axes = Camera.looking_at(INTRINSICS, [0, height, 0], [0, 0, 0]).axes
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert np.allclose(axes[1], [0, 0, 1])  # down in the image


def test_camera_at_the_origin_looks_along_minus_z_with_y_up():
    depth = np.zeros((18, 24))
    depth[0, 23] = 2.0
    x, y, z = Camera.at_origin(INTRINSICS).unproject(depth)[0]
    assert x > 0
    assert y > 0
    assert z == -2
    with pytest.raises(InvalidArgument, match="depth"):
        Camera.at_origin(INTRINSICS).unproject(depth.T)


def test_axes_are_a_right_handed_frame_with_the_target_in_the_middle():
    camera = Camera.looking_at(INTRINSICS, [1, 2, 3], [-1, 0, 0.5])
    assert np.allclose(camera.axes @ camera.axes.T, np.eye(3))
    assert np.linalg.det(camera.axes) == pytest.approx(1)
    assert np.allclose(camera.project(np.array([[-1, 0, 0.5]])), [[11.5, 8.0]])
    above, below = camera.project(np.array([[-1, 0.2, 0.5], [-1, -0.2, 0.5]]))
    assert above[1] < below[1]


def test_splats_are_discs_and_the_nearest_point_wins():
    depth, index = np.full((18, 24), np.inf), np.full((18, 24), -1, np.int32)
    points = np.array([[0.05, 0.05, 2.0], [0.05, 0.05, 3.0], [0, 0, -1.0], [99.0, 0, 1.0]])
    zbuffer.splat(points, Lens(20.0, 20.0, 11.5, 8.5), 2.0, depth, index)
    assert (index == 0).sum() == 13  # lattice points within 2 of a lattice point
    assert {*np.unique(index)} == {-1, 0}

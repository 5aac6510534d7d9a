"""Stage B at open boundaries: where the cloud ends."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.garment import model
from ddakf.kernels.hem import gaps_across_view
from tests.physics.shapes import ball, grid_faces
from tests.stages.scenes import associated, cloud_of, rms, scan, tube

CONFIG = Config()
GATE = CONFIG.associate.narrow_gate


def sheet(n=16, spacing=0.02) -> Mesh:
    """A flat square of 30 cm."""
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2) * spacing
    return Mesh(np.column_stack([grid, np.zeros(len(grid))]), grid_faces(n, n))


def hem_of(mesh, points, position, config=CONFIG):
    garment = model.build(mesh)
    cloud = cloud_of(points, None, position, garment.area, config)
    return garment, associated(position, cloud, garment, GATE, config.associate).hem


def at_border(garment, position, border) -> np.ndarray:
    """(H,) bool: boundary vertices on the side x = border of the sheet, away from its corners."""
    x, y = position[garment.boundary[:, 0], 0], position[garment.boundary[:, 0], 1]
    return (np.abs(x - border) < 1e-9) & (y > 0.05) & (y < 0.25)


@pytest.mark.parametrize("shift", [-0.012, 0.0, 0.012])
@pytest.mark.parametrize("count", [1500, 6000])
def test_the_end_of_the_cloud_is_where_the_cloth_ends(shift, count):
    mesh = sheet()
    position = mesh.vertices + [shift, 0.0, 0.0]
    garment, hem = hem_of(mesh, scan(mesh.vertices, mesh, count, 0.002), position)
    side = at_border(garment, position, 0.3 + shift) & (hem.weight > 0)
    assert side.sum() >= 5
    np.testing.assert_allclose(hem.direction[side], np.tile([1.0, 0.0, 0.0], (side.sum(), 1)), atol=1e-9)
    assert np.median(hem.offset[side]) == pytest.approx(-shift, abs=0.003)


def test_a_sparse_cloud_has_ends_too():
    mesh, found, offsets = sheet(), {0.0: [], CONFIG.associate.hem_spacings: []}, []
    for spacings, seen in found.items():
        config = dataclasses.replace(CONFIG, associate=dataclasses.replace(CONFIG.associate, hem_spacings=spacings))
        for seed in range(20):
            points = scan(mesh.vertices, mesh, 150, 0.002, seed)
            garment, hem = hem_of(mesh, points, mesh.vertices, config)
            side = at_border(garment, mesh.vertices, 0.3)
            seen.append(hem.weight[side] > 0)
            offsets.append(hem.offset[side][seen[-1]] if spacings else [])
    narrow, wide = (np.mean(seen) for seen in found.values())
    assert wide > 0.6 > 2.0 * narrow
    assert np.mean(np.concatenate(offsets)) == pytest.approx(0.0, abs=0.006)


def test_cloth_that_goes_on_has_no_end():
    mesh = sheet()
    wide = Mesh(mesh.vertices * [1.5, 1.0, 1.0], mesh.faces)
    garment, hem = hem_of(mesh, scan(wide.vertices, wide, 6000, 0.002), mesh.vertices)
    assert not hem.weight[at_border(garment, mesh.vertices, 0.3)].any()


def test_a_vertex_that_is_not_seen_has_no_end():
    mesh = sheet()
    garment = model.build(mesh)
    behind = np.array([0.15, 0.15, -2.0])
    cloud = cloud_of(scan(mesh.vertices, mesh, 6000, 0.002), behind, mesh.vertices, garment.area, CONFIG)
    assert not associated(mesh.vertices, cloud, garment, GATE, CONFIG.associate).hem.weight.any()


def ball_from(eye, points) -> np.ndarray:
    """Gaps beside the rim of a ball, and beside its other vertices that face the eye, in mm."""
    mesh, gaps = ball(), np.empty(2)
    normal = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    seen = np.einsum("va,va->v", normal, eye - mesh.vertices) > 0.0
    cloud = np.ascontiguousarray(np.asarray(points, np.float32).T)
    gaps_across_view(mesh.vertices, normal, seen, cloud, eye, 0.5, 0.04, gaps)
    return 1e3 * gaps


@pytest.mark.parametrize("distance", [0.6, 2.0, 5.0])
def test_a_mask_that_is_too_narrow_leaves_a_gap_beside_the_rim(distance):
    """Across the view, however steep the surface is there, and as wide as at the middle of the ball from any distance."""
    mesh, eye = ball(), np.array([0.0, 0.0, distance])
    points = scan(mesh.vertices, mesh, 20_000, 0.0)
    points = points[points @ eye > np.square(points).sum(axis=1)]  # of the half that faces the eye
    across = np.linalg.norm(points[:, :2] / (distance - points[:, 2:]) * distance, axis=1)
    rim, others = ball_from(eye, points)
    assert max(rim, others) < 4.0
    narrow, inside = ball_from(eye, points[across < across.max() - 0.02])
    assert narrow > 2.0 * max(inside, 4.0)
    assert 8.0 < narrow < 22.0


def test_vertices_far_from_all_points_leave_no_gap():
    """They are outside the image, or hidden: of half a ball the other half says nothing."""
    mesh, eye = ball(), np.array([0.0, 0.0, 2.0])
    points = scan(mesh.vertices, mesh, 20_000, 0.0)
    assert ball_from(eye, points[points[:, 0] > 0.0]) == pytest.approx(ball_from(eye, points), abs=3.0)
    assert (ball_from(eye, points + np.float32([1.0, 0.0, 0.0])) == 0.0).all()
    assert (ball_from(eye, points[:0]) == 0.0).all()
    assert (ball_from(eye, points * [1.0, 1.0, -1.0] + [0.0, 0.0, 9.0]) == 0.0).all(), "behind the eye"


def test_a_closed_surface_has_no_boundary():
    mesh = ball()
    _, hem = hem_of(mesh, scan(mesh.vertices, mesh, 3000, 0.002), mesh.vertices)
    assert hem is None


def test_each_boundary_vertex_lies_between_its_neighbours():
    mesh = tube()
    boundary = model.build(mesh).boundary
    assert len(boundary) == 2 * 24
    pairs = {tuple(pair) for pair in np.sort(mesh.edges, axis=1)}
    for vertex, before, after in boundary:
        assert tuple(sorted((vertex, before))) in pairs
        assert tuple(sorted((vertex, after))) in pairs
    np.testing.assert_array_equal(np.sort(boundary[:, 1]), np.sort(boundary[:, 0]))


def test_cloth_that_slipped_along_itself_returns():
    """Planes alone cannot tell where a flat sheet lies in its plane."""
    mesh = sheet()
    slipped = mesh.vertices + [0.012, 0.0, 0.0]
    errors = {}
    for reach in (CONFIG.associate.hem_reach, 0.0):
        config = dataclasses.replace(CONFIG, associate=dataclasses.replace(CONFIG.associate, hem_reach=reach))
        tracker = Tracker(mesh, config=config)
        tracker.reset(vertices=slipped)
        for k in range(10):
            result = tracker.step(scan(mesh.vertices, mesh, 3000, 0.002, seed=k), timestamp=k / 30)
        errors[reach > 0] = rms(result.vertices - mesh.vertices)
    assert errors[True] < 0.5 * errors[False]
    assert errors[True] < 0.004


"""Stage B at open boundaries: where the cloud ends."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.garment import model
from ddakf.kernels.hem import unmeasured_rim
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


def test_the_rim_of_a_ball_faces_its_sensors_least():
    mesh = ball()
    normal, eye = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True), np.array([[0.0, 0.0, 3.0]])
    to_eye = eye - mesh.vertices
    facing = np.einsum("va,va->v", normal, to_eye) / np.linalg.norm(to_eye, axis=1)
    seen = facing > 0.1
    rim, nothing = seen & (facing <= 0.5), np.zeros(len(seen), bool)
    for bare, share in ((rim, 1.0), (seen & ~rim, 0.0), (seen, 0.0), (nothing, 0.0)):
        distance = np.where(bare, -1.0, 0.0)
        assert unmeasured_rim(mesh.vertices, normal, seen, distance, eye, 0.5) == share
        assert unmeasured_rim(mesh.vertices, normal, nothing, distance, eye, 0.5) == 0.0
    around = np.concatenate([eye, -eye, *(eye[:, order] for order in ([2, 0, 1], [1, 2, 0]))])
    some = np.where(rim, -1.0, 0.0)
    assert unmeasured_rim(mesh.vertices, normal, seen, some, around, 0.2) == 0.0, "from several sides nothing is a rim"


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


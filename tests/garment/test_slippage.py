"""Slippage of surfaces along themselves."""

import numpy as np
import pytest

from ddakf import Mesh
from ddakf.evaluation.datasets import collection
from ddakf.garment import model, slippage
from ddakf.garment.slippage import TINY, fold_height, least_normal_share, least_seen_turn
from ddakf.kernels import slippage as kernels
from ddakf.mesh import vertex_normals
from tests.stages.scenes import turn
from tests.tracker_runs import SHIRT


def tube(radii=(0.2, 0.2), height=0.6, around=48, along=12):
    angle, y = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0, height, along))
    vertices = np.column_stack([radii[0] * np.cos(angle).ravel(), y.ravel(), radii[1] * np.sin(angle).ravel()])
    row, column = np.meshgrid(np.arange(along - 1), np.arange(around), indexing="ij")
    a, b = row * around + column, row * around + (column + 1) % around
    quads = np.stack([a, a + around, b + around, b], axis=-1).reshape(-1, 4)
    return vertices, np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def test_a_round_tube_turns_unnoticed_and_an_oval_one_less():
    shares = [least_normal_share(*tube(radii)) for radii in ((0.2, 0.2), (0.22, 0.18), (0.26, 0.14))]
    assert shares[0] < 1e-3
    assert (np.diff(shares) > -1e-12).all()


def test_a_shirt_slips_less_than_a_tube():
    assert least_normal_share(SHIRT.vertices, SHIRT.faces) > 0.05


@pytest.mark.parametrize(
    ("garments", "least", "most"),
    [
        ({"straight-skirt"}, 0.02, 0.03),
        ({"skirt", "dress", "trousers"}, 0.02, 0.055),
        ({"tshirt", "long-shirt", "hoodie", "jacket"}, 0.08, 0.155),
    ],
    ids=["straight", "skirts and trousers", "sleeves"],
)
def test_garments_slip_by_their_shape(garments, least, most):
    chosen = [each for each in collection.listed(collection.TRAINING) if each.garment in garments]
    recordings = [collection.load(each.name) for each in chosen]
    shares = [least_normal_share(each.garment_vertices[0], each.garment_faces) for each in recordings]
    assert len(shares) >= 4
    assert least < min(shares) <= max(shares) < most


def test_place_size_and_orientation_change_nothing():
    vertices, faces = tube((0.25, 0.15))
    share = least_normal_share(vertices, faces)
    moved = 3.0 * vertices @ turn(40).T + [1.0, -2.0, 5.0]
    assert least_normal_share(moved, faces) == pytest.approx(share, rel=1e-6)


@pytest.mark.parametrize("scale", [(0, 0, 0), (0, 1, 0), (1, 1, 0)])
def test_a_surface_that_is_folded_flat_has_a_share(scale):
    vertices, faces = tube()
    assert 0.0 <= least_normal_share(vertices * scale, faces) <= 1.0


@pytest.mark.parametrize("faces", [[[0, 1, 2]], [[0, 1, 2], [2, 1, 3]]], ids=["one", "two"])
def test_a_few_triangles_slip(faces):
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]])
    assert 0.0 <= least_normal_share(vertices, np.array(faces)) <= 0.34


@pytest.mark.parametrize("scale", [(1, 1, 1), (0, 0, 0), (0, 1, 0), (1, 1, 0)], ids=["tube", "point", "line", "flat"])
def test_the_smallest_share_is_that_of_numpy(scale):
    vertices, faces = tube((0.25, 0.15))
    along, moved = np.empty((6, 6)), np.empty((6, 6))
    if kernels.rigid_motions(vertices * scale, faces, along, moved) == 0.0:
        assert least_normal_share(vertices * scale, faces) == 0.0
        return
    inverse_root = np.linalg.inv(np.linalg.cholesky(moved + TINY * np.diag([0, 0, 0, 1, 1, 1])))
    expected = np.linalg.eigvalsh(inverse_root @ along @ inverse_root.T)
    got = kernels.smallest_share(along, moved, TINY)
    assert got == pytest.approx(expected[0], rel=1e-9, abs=1e-12 * expected[-1])


@pytest.mark.parametrize("seed", range(5))
def test_the_smallest_share_of_random_forms_is_that_of_numpy(seed):
    rng = np.random.default_rng(seed)
    first, second = rng.normal(size=(6, 6)), rng.normal(size=(3, 3))
    along, moved = first @ first.T, np.eye(6)
    moved[3:, 3:] = second @ second.T + 0.1 * np.eye(3)
    expected = np.linalg.eigvals(np.linalg.solve(moved, along)).real.min()
    assert kernels.smallest_share(along, moved, 0.0) == pytest.approx(expected, rel=1e-8)


def seen(vertices, faces):
    mesh = Mesh(vertices, faces)
    built = model.build(mesh)
    return least_seen_turn(vertices, vertex_normals(vertices, mesh.faces), mesh.faces, built.boundary)


def test_the_turn_that_a_tube_hides_is_about_its_axis():
    vertices, faces = tube()
    found = seen(vertices, faces)
    assert found.share < 1e-3
    about = np.cross([0.0, 1.0, 0.0], vertices)  # m per radian
    np.testing.assert_allclose(np.abs(np.einsum("va,va->v", found.moved, about)), np.square(about).sum(axis=1), rtol=1e-3)
    assert found.share < seen(*tube((0.22, 0.18))).share < seen(*tube((0.26, 0.14))).share


def test_a_square_cloth_shows_by_its_edges_that_it_turns():
    across, along = np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.5, 0.5, 21))
    corner = (np.arange(20) * 21 + np.arange(20)[:, None]).ravel()
    faces = np.vstack([np.stack([corner, corner + 1, corner + 22], axis=1), np.stack([corner, corner + 22, corner + 21], axis=1)])
    assert seen(np.stack([across.ravel(), np.zeros(441), along.ravel()], axis=1), faces).share > 0.2


@pytest.mark.parametrize("degenerate", [(0, 0, 0), (0, 1, 0), (1, 1, 0)])
def test_a_surface_that_is_folded_flat_has_a_turn(degenerate):
    vertices, faces = tube()
    built = model.build(Mesh(vertices, faces))
    found = least_seen_turn(vertices * degenerate, np.tile([0.0, 0.0, 1.0], (len(vertices), 1)), faces, built.boundary)
    assert 0.0 <= found.share <= 1.0
    assert np.isfinite(found.moved).all()


def test_the_folds_of_a_tiny_garment_cost_no_more(monkeypatch):
    vertices, faces = tube((0.01, 0.01), around=96, along=36)
    built, passes, smoothed = model.build(Mesh(vertices, faces)), [], slippage._smoothed
    monkeypatch.setattr(slippage, "_smoothed", lambda *a: passes.append(a[2]) or smoothed(*a))
    fold_height(vertices, vertex_normals(vertices, faces), (built.start, built.neighbour), built.edge_length)
    assert max(passes) <= slippage.MOST_PASSES


@pytest.mark.parametrize("radii", [(0.2, 0.2), (0.24, 0.16)])
def test_folds_have_a_height_and_a_smooth_tube_has_none(radii):
    vertices, faces = tube(radii, around=96, along=36)
    built = model.build(Mesh(vertices, faces))
    around, heights = np.arctan2(vertices[:, 2], vertices[:, 0]), []
    for folds in (0.0, 0.002, 0.004):  # m, amplitude; 5 cm wide
        folded = vertices * (1.0 + folds / 0.2 * np.cos(24 * around))[:, None] ** [1, 0, 1]
        rings = built.start, built.neighbour
        heights.append(fold_height(folded, vertex_normals(folded, faces), rings, built.edge_length))
    assert heights[0] < 1e-4
    assert heights[1] > 3e-4
    assert heights[2] == pytest.approx(2.0 * heights[1], rel=0.1)

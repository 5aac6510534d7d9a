"""Remeshing: the surface stays, the triangles become even."""

import numpy as np
import pytest

from ddakf import Config, Mesh
from ddakf.garment import remeshing, working_mesh
from ddakf.garment.remeshing import areas, boundary_loops, remesh, subdivided
from tests.garment.shapes import centre_split, sheet, sieve, turned_about_y, turned_numbers
from tests.lanes import every
from tests.stages.scenes import tube
from tests.tracker_runs import SHIRT

EDGE = 0.03
SHAPES = pytest.mark.parametrize(
    "mesh",
    [SHIRT, tube(), sheet(), centre_split(SHIRT), subdivided(tube(), 0.02)[0]],
    ids=["shirt", "tube", "sheet", "split shirt", "fine tube"],
)


def lengths(mesh):
    ends = mesh.vertices[mesh.edges]
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def pieces_openings_handles(mesh):
    return remeshing._topology(mesh)


@SHAPES
def test_edges_are_even_and_of_the_wanted_length(mesh):
    length = lengths(remesh(mesh, EDGE).mesh)
    assert abs(length.mean() / EDGE - 1) < 0.15
    assert np.log(length).std() < 0.25


@SHAPES
def test_pieces_openings_and_area_stay(mesh):
    even = remesh(mesh, EDGE).mesh
    assert pieces_openings_handles(even) == pieces_openings_handles(mesh)
    assert areas(even).sum() == pytest.approx(areas(mesh).sum(), rel=0.04)  # chords of a curved surface are shorter


@SHAPES
def test_vertices_lie_on_the_surface_and_faces_look_outward(mesh):
    even = remesh(mesh, EDGE)
    on_surface = np.einsum("wk,wka->wa", even.share, mesh.vertices[even.corner])
    np.testing.assert_allclose(even.mesh.vertices, on_surface, atol=1e-12)
    known = {tuple(sorted(face)) for face in mesh.faces.tolist()}
    inside = (even.share > 0).all(axis=1)
    assert all(tuple(sorted(corner)) in known for corner in even.corner[inside].tolist())
    centre = mesh.vertices.mean(axis=0)

    def volume(mesh):
        return np.linalg.det(mesh.vertices[mesh.faces] - centre).sum()

    assert volume(even.mesh) == pytest.approx(volume(mesh), rel=0.1, abs=1e-4)


def test_the_triangulation_hardly_matters():
    counts = [remesh(mesh, 0.02).mesh.n_vertices for mesh in (SHIRT, centre_split(SHIRT), subdivided(SHIRT, 0.01)[0])]
    assert max(counts) < 1.06 * min(counts)


def test_the_numbering_does_not_matter():
    a, b = remesh(SHIRT, EDGE), remesh(turned_numbers(SHIRT), EDGE)
    a, b = (np.sort(np.round(even.mesh.vertices, 9).view("f8,f8,f8").ravel()) for even in (a, b))
    np.testing.assert_array_equal(a, b)


def test_a_narrow_opening_is_surrounded_by_short_edges():
    narrow = Mesh(tube().vertices * [0.1, 1.0, 0.1], tube().faces)
    around = min(len(loop) for loop in boundary_loops(narrow))
    even = remesh(subdivided(narrow, 0.01)[0], EDGE)
    assert around > 6
    assert even is not None
    assert min(len(loop) for loop in boundary_loops(even.mesh)) >= 6


def test_a_part_thinner_than_an_edge_stays_and_the_rest_keeps_its_edges():
    """A ball of 0.15 m with a finger of 6 mm, closed."""
    ball, finger = np.linspace(-np.pi / 2, 1.53, 40), np.linspace(0.16, 0.25, 30)
    profile = [*0.15 * np.stack([np.cos(ball), np.sin(ball)], axis=1), *[(0.006, y) for y in finger], (0.0, 0.256)]
    mesh = turned_about_y(np.array(profile))
    even = remesh(mesh, EDGE)
    assert even is not None
    assert pieces_openings_handles(even.mesh) == pieces_openings_handles(mesh)
    middle = even.mesh.vertices[even.mesh.edges].mean(axis=1)[:, 1]
    length = lengths(even.mesh)
    assert length[middle > 0.17].mean() < 0.015
    assert length[middle < 0.0].mean() == pytest.approx(EDGE, rel=0.15)
    assert areas(even.mesh).sum() == pytest.approx(areas(mesh).sum(), rel=0.04)


@pytest.mark.parametrize("longest", [0.05, 0.02, 0.009])
def test_subdivision_keeps_the_surface(longest):
    fine, place = subdivided(SHIRT, longest)
    assert lengths(fine).max() <= longest
    assert pieces_openings_handles(fine) == pieces_openings_handles(SHIRT)
    assert areas(fine).sum() == pytest.approx(areas(SHIRT).sum(), rel=1e-9)
    np.testing.assert_allclose(working_mesh.interpolated(SHIRT.vertices, *place), fine.vertices, atol=1e-12)
    np.testing.assert_array_equal(fine.vertices[: SHIRT.n_vertices], SHIRT.vertices)


def test_however_long_the_edges_a_tube_stays_one():
    even = remesh(tube(), 10.0).mesh
    assert even.n_vertices < 20
    assert pieces_openings_handles(even) == pieces_openings_handles(tube())


@pytest.mark.slow
def test_needles_are_refused_before_they_take_memory():
    needle = Mesh(np.array([[0, 0, 0], [5000, 0, 0], [0, 1e-3, 0]]), np.array([[0, 1, 2]]))
    assert subdivided(needle, 0.001) is None
    assert remesh(needle, 0.001) is None
    assert working_mesh.build(needle, Config().discretisation).mesh is needle


def test_a_sieve_is_tried_once(monkeypatch):
    """Its holes are smaller than the edges and too many to be kept; finer and finer tries would take half a minute."""
    tries = []
    monkeypatch.setattr(remeshing, "subdivided", lambda *what: tries.append(what) or subdivided(*what))
    mesh = sieve(100, 0.005, 3)
    assert working_mesh.build(mesh, Config().discretisation).mesh is mesh
    assert len(tries) == 1


def missing(mesh, places, pinched=False):
    """The mesh without a triangle in so many places, or without two that share a corner alone."""
    rim, gone, used = mesh.boundary_vertices, [], set()
    for face in np.random.default_rng(0).permutation(mesh.n_faces):
        around = np.flatnonzero((mesh.faces == mesh.faces[face, 0]).any(axis=1))
        near = set(mesh.faces[around].ravel().tolist())
        across = [f for f in around if len(set(mesh.faces[face]) & set(mesh.faces[f])) == 1]
        if not rim[list(near)].any() and not near & used and across:
            gone += [face, across[0]] if pinched else [face]
            used |= near
        if len(gone) >= places:
            break
    return Mesh(mesh.vertices, np.delete(mesh.faces, gone, axis=0))


def with_belt_loops(mesh, count):
    """The mesh with thin tubes between faces 5 cm apart: handles that no even mesh of long edges has."""
    centre, rim, faces, gone, used = mesh.vertices[mesh.faces].mean(axis=1), mesh.boundary_vertices, [], [], set()
    for one in np.random.default_rng(0).permutation(mesh.n_faces):
        other = np.abs(np.linalg.norm(centre - centre[one], axis=1) - 0.05).argmin()
        corners = {*mesh.faces[one].tolist(), *mesh.faces[other].tolist()}
        if rim[list(corners)].any() or corners & used:
            continue
        a, back = mesh.faces[one], mesh.faces[other][::-1]
        b = min((np.roll(back, k) for k in range(3)), key=lambda b: np.linalg.norm(mesh.vertices[a] - mesh.vertices[b]))
        faces += [(a[k], a[(k + 1) % 3], b[(k + 1) % 3]) for k in range(3)] + [(a[k], b[(k + 1) % 3], b[k]) for k in range(3)]
        gone, used = [*gone, one, other], used | corners
        if len(gone) == 2 * count:
            break
    return Mesh(mesh.vertices, np.concatenate([np.delete(mesh.faces, gone, axis=0), faces]))


FINE = subdivided(SHIRT, 0.012)[0]


@pytest.mark.parametrize(
    "mesh",
    every(3, [missing(FINE, 2, pinched=True), missing(FINE, 100), with_belt_loops(FINE, 6)]),
    ids=["pinched", "100 missing triangles", "belt loops"],
)
def test_defects_of_a_fine_template_cost_it_no_even_mesh(mesh):
    even, whole = remesh(mesh, EDGE), remesh(FINE, EDGE).mesh
    assert even.mesh.n_vertices == pytest.approx(whole.n_vertices, rel=0.05)
    assert np.abs(np.log(np.median(lengths(even.mesh)) / EDGE)) < 0.15
    assert areas(even.mesh).sum() == pytest.approx(areas(whole).sum(), rel=0.01)
    assert even.owner.shape == (mesh.n_vertices,)
    assert even.corner.max() < mesh.n_vertices
    on_surface = np.einsum("wk,wka->wa", even.share, mesh.vertices[even.corner])
    np.testing.assert_allclose(even.mesh.vertices, on_surface, atol=1e-12)
    working = working_mesh.build(mesh, Config().discretisation)
    assert working.mesh.n_vertices < 0.6 * mesh.n_vertices
    assert np.linalg.norm(working.spread(working.sampled(mesh.vertices)) - mesh.vertices, axis=1).max() < 0.02


def test_a_pinched_vertex_is_one_of_each_sheet():
    """Two triangles that share a corner, and no other."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0.0]])
    apart, original = remeshing._without_pinches(Mesh(vertices, np.array([[0, 1, 2], [0, 3, 4]])))
    assert (apart.n_vertices, original.tolist()) == (6, [0, 1, 2, 3, 4, 0])
    assert len(boundary_loops(apart)) == 2
    same, original = remeshing._without_pinches(SHIRT)
    assert same is SHIRT
    assert (original == np.arange(SHIRT.n_vertices)).all()


@pytest.mark.parametrize("fold", ["point", "line"])
def test_a_folded_mesh_of_many_pieces_is_survived(fold):
    """Faces just above the least area, most of them apart from each other."""
    rng = np.random.default_rng(0)
    corners = 2e-6 * rng.random((6000, 3)) + ([0, 0, 0] if fold == "point" else np.outer(np.arange(6000) // 3, [1e-3, 0, 0]))
    mesh, _ = Mesh.cleaned(corners, np.arange(6000).reshape(-1, 3))
    assert working_mesh.build(mesh, Config().discretisation).mesh.n_vertices >= 3


@pytest.mark.parametrize("side", [0.005, 0.008, 0.012, 0.02, 0.03])
def test_the_last_edge_of_a_small_opening_may_be_its_longest(side):
    """Seeds may then be wanted within it."""
    for seed in range(10):
        corners = np.random.default_rng(seed).normal(scale=side, size=(3, 3))
        remesh(Mesh(corners, np.array([[0, 1, 2]])), 0.02)

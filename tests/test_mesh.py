"""Meshes: every defect is refused with its count, and repaired by cleaned() with a map that tells which vertex is which."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import Mesh, Tracker
from ddakf.errors import InvalidMesh
from ddakf.mesh import vertex_normals
from tests.physics.shapes import ball, rotation, sheet
from tests.stages.scenes import tube

GOOD = sheet()
V, F = GOOD.vertices, GOOD.faces


def unreferenced():
    return np.insert(V, [3, 9], [[5.0, 5.0, 5.0], [6.0, 6.0, 6.0]], axis=0), F + (F >= 3) + (F >= 9)


def duplicate():
    return V, np.concatenate([F, F[:3][:, [1, 2, 0]]])  # the same triangles, written from another corner


def turned_duplicate():
    return V, np.concatenate([F, F[:2][:, ::-1]])


def repeated_corner():
    return V, np.concatenate([F, [[0, 0, 1], [2, 5, 2]]])


def no_area():
    a, b = V[0], V[1]
    return np.concatenate([V, [0.5 * (a + b)]]), np.concatenate([F, [[0, 1, len(V)]]])


def non_manifold():
    fin = V[[5, 6]].mean(axis=0) + [0.0, 0.0, 0.001]  # the smallest of three faces at the edge
    return np.concatenate([V, [fin]]), np.concatenate([F, [[5, 6, len(V)]]])


def wound_apart():
    return V, np.concatenate([F[:1][:, ::-1], F[1:]])


def soup():
    return V[F].reshape(-1, 3), np.arange(3 * len(F)).reshape(-1, 3)


DEFECTS = {
    unreferenced: "2 unreferenced vertices",
    duplicate: "3 duplicate faces",
    turned_duplicate: "2 duplicate faces",
    repeated_corner: "2 degenerate faces",
    no_area: "1 degenerate faces",
    non_manifold: "1 non-manifold edges",
    wound_apart: "edges between faces of opposite winding",
    soup: "vertices at the place of another",
}
ANY = pytest.mark.parametrize("defect", list(DEFECTS), ids=lambda d: d.__name__)


@ANY
def test_defects_are_refused_with_their_count_and_the_way_to_repair_them(defect):
    with pytest.raises(InvalidMesh, match=DEFECTS[defect]) as refusal:
        Mesh(*defect())
    assert "cleaned()" in str(refusal.value)
    assert "clean=true" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@ANY
def test_cleaning_repairs_and_says_which_vertices_remain(defect):
    vertices, faces = defect()
    mesh, kept = Mesh.cleaned(vertices, faces)
    np.testing.assert_array_equal(mesh.vertices, vertices[kept])
    assert (np.diff(kept) > 0).all()
    Mesh(mesh.vertices, mesh.faces)  # nothing is left to refuse
    # in the places of the input every face of the result was there, with the same turn but where it was against its neighbours'
    turns = {tuple(map(tuple, vertices[np.roll(face, k)])) for face in faces for k in range(3)}
    new = [corners for corners in mesh.vertices[mesh.faces] if tuple(map(tuple, corners)) not in turns]
    assert len(new) == (defect is wound_apart)


@ANY
def test_cleaning_takes_no_more_than_the_defect(defect):
    mesh, kept = Mesh.cleaned(*defect())
    assert mesh.n_faces == len(F)
    np.testing.assert_allclose(np.unique(mesh.vertices, axis=0), np.unique(V, axis=0))
    np.testing.assert_allclose(mesh.vertices[mesh.faces], V[F])  # in the same order and from the same corners
    assert len(kept) == mesh.n_vertices


def test_both_sides_of_a_sheet_are_one_beside_other_parts():
    """As many exports have it: every triangle twice, of vertices of their own, and buttons once."""
    sheet, n = tube(), tube().n_vertices
    buttons = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]]) + np.arange(3)[:, None, None] * [0.0, 0.1, 0.0] + [1.0, 0.0, 0.0]
    vertices = np.concatenate([sheet.vertices, sheet.vertices, buttons.reshape(-1, 3)])
    faces = np.concatenate([sheet.faces, sheet.faces[:, ::-1] + n, 2 * n + np.arange(9).reshape(3, 3)])
    mesh, kept = Mesh.cleaned(vertices, faces)
    assert (mesh.n_vertices, mesh.n_faces) == (n + 9, sheet.n_faces + 3)
    np.testing.assert_array_equal(kept, np.append(np.arange(n), 2 * n + np.arange(9)))
    assert Tracker(mesh).working_vertices <= n


def test_all_defects_at_once_are_counted_apart_and_repaired_together():
    vertices, faces = unreferenced()
    used = np.unique(faces)
    faces = np.concatenate([faces, faces[:1], [[used[0], used[0], used[1]]]])
    with pytest.raises(InvalidMesh) as refusal:
        Mesh(vertices, faces)
    for part in ("2 unreferenced vertices", "1 duplicate faces", "1 degenerate faces"):
        assert part in str(refusal.value)
    mesh, kept = Mesh.cleaned(vertices, faces)
    np.testing.assert_allclose(mesh.vertices, V)
    assert 3 not in kept


def test_a_good_mesh_is_left_as_it_is():
    mesh, kept = Mesh.cleaned(V, F)
    np.testing.assert_array_equal(mesh.vertices, V)
    np.testing.assert_array_equal(mesh.faces, F)
    np.testing.assert_array_equal(kept, np.arange(len(V)))


def test_a_surface_with_one_side_is_a_mesh():
    """A scarf sewn into a ring with half a turn."""
    n = 12
    upper, lower = np.arange(n), np.arange(n) + n
    after = np.append(upper[1:], lower[0]), np.append(lower[1:], upper[0])
    faces = np.concatenate([np.stack([upper, after[0], lower], 1), np.stack([lower, after[0], after[1]], 1)])
    angle = 2 * np.pi * np.arange(n) / n
    tilt = np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], 1)
    middle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    assert Mesh(np.concatenate([middle + 0.2 * tilt, middle - 0.2 * tilt]), faces).n_faces == 2 * n


UNREPAIRABLE = {
    "vertices of two coordinates": (V[:, :2], F, "mesh.vertices"),
    "vertices of text": (V.astype(str), F, "mesh.vertices"),
    "complex vertices": (V.astype(complex), F, "mesh.vertices"),
    "a vertex that is not a number": (np.where(np.arange(20)[:, None] == 7, np.nan, V), F, "mesh.vertices"),
    "an infinite vertex": (np.where(np.arange(20)[:, None] == 7, np.inf, V), F, "mesh.vertices"),
    "quads": (V, np.column_stack([F, F[:, 0]]), "mesh.faces"),
    "indices that are no integers": (V, F.astype(float), "mesh.faces"),
    "an index beyond the last": (V, np.where(F == 19, 20, F), "mesh.faces"),
    "a negative index": (V, np.where(F == 0, -1, F), "mesh.faces"),
    "no faces": (V, F[:0], "mesh"),
    "no vertices": (V[:0], F, "mesh"),
    "a vertex out of reach": (V * 1e9, F, "mesh.vertices"),
    "no area anywhere": (V * 0, F, "mesh"),
}


@pytest.mark.parametrize("what", list(UNREPAIRABLE))
def test_what_cannot_be_repaired_is_refused_by_both(what):
    vertices, faces, field = UNREPAIRABLE[what]
    for make in (Mesh, Mesh.cleaned):
        with pytest.raises(InvalidMesh) as refusal:
            make(vertices, faces)
        error = refusal.value
        assert error.field == field
        assert str(error) == f"{error.field}: expected {error.expected}, got {error.got}"
        assert "\n" not in str(error)


def test_what_is_no_array_is_named_by_its_type():
    with pytest.raises(InvalidMesh, match=r"^mesh\.vertices: expected numbers of shape \(V, 3\), got NoneType$"):
        Mesh(None, F)
    with pytest.raises(InvalidMesh, match=r"^mesh\.faces: expected integers of shape \(F, 3\), got generator$"):
        Mesh(V, (face for face in F))


def test_rows_of_different_lengths_are_refused():
    with pytest.raises(InvalidMesh):
        Mesh([[0, 0, 0], [1, 0]], [[0, 1, 0]])


def test_the_message_names_how_many_are_not_finite_and_the_first():
    vertices = V.copy()
    vertices[[4, 11], 1] = np.nan
    with pytest.raises(InvalidMesh, match=r"2 non-finite, the first at 4"):
        Mesh(vertices, F)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_random_faces_are_either_refused_or_cleaned_into_a_mesh(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(rng.integers(3, 12), 3))
    faces = rng.integers(0, len(vertices), (rng.integers(1, 30), 3))
    try:
        mesh, kept = Mesh.cleaned(vertices, faces)
    except InvalidMesh:
        return
    np.testing.assert_array_equal(mesh.vertices, vertices[kept])
    assert {tuple(sorted(face)) for face in kept[mesh.faces]} <= {tuple(sorted(face)) for face in faces}
    sides = [tuple(sorted(pair)) for a, b, c in mesh.faces.tolist() for pair in ((a, b), (b, c), (c, a))]
    assert max(map(sides.count, sides)) <= 2
    assert [tuple(edge) for edge in mesh.edges.tolist()] == sorted(set(sides))
    hem = {vertex for side in sides if sides.count(side) == 1 for vertex in side}
    assert set(np.flatnonzero(mesh.boundary_vertices)) == hem


def test_the_arrays_are_the_meshs_own_and_cannot_be_written():
    vertices, faces = V.copy(), F.copy()
    mesh = Mesh(vertices, faces)
    vertices[0] = 7.0
    assert mesh.vertices[0, 0] != 7.0
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        mesh.faces[0] = 1


def test_edges_boundary_and_length():
    assert len(GOOD.edges) == 4 * 4 + 5 * 3 + 4 * 3  # along, across and diagonal of 5 x 4 vertices
    assert (GOOD.edges[:, 0] < GOOD.edges[:, 1]).all()
    rows, columns = np.divmod(np.arange(20), 4)
    np.testing.assert_array_equal(GOOD.boundary_vertices, (rows % 4 == 0) | (columns % 3 == 0))
    assert not ball().boundary_vertices.any()
    lengths = [np.linalg.norm(V[i] - V[j]) for i, j in GOOD.edges]
    assert GOOD.edge_length == pytest.approx(np.mean(lengths))


def test_normals_of_a_ball_point_outward_and_turn_with_it():
    mesh, R = ball(3, 0.2), rotation(1)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    assert (np.einsum("va,va->v", normals, mesh.vertices / 0.2) > 0.99).all()
    np.testing.assert_allclose(vertex_normals(mesh.vertices @ R.T, mesh.faces), normals @ R.T, atol=1e-12)
    assert not vertex_normals(mesh.vertices * 0, mesh.faces).any()


def test_seams_of_a_texture_are_counted_and_joined():
    """A file that gives each vertex one texture coordinate splits a tube along a line from hem to hem."""
    whole = tube()
    around = np.flatnonzero(np.isclose(whole.vertices[:, 1], whole.vertices[0, 1])).size
    column, line = np.arange(whole.n_vertices) % around, np.arange(0, whole.n_vertices, around)
    copy = np.arange(whole.n_vertices)
    copy[line] = whole.n_vertices + np.arange(len(line))
    right = (column[whole.faces] == 1).any(axis=1)
    faces = np.where(right[:, None], copy[whole.faces], whole.faces)
    split = Mesh(np.concatenate([whole.vertices, whole.vertices[line]]), faces)
    assert whole.split_edges == 0
    assert split.split_edges == 2 * (len(line) - 1) > 0
    joined, kept = Mesh.cleaned(split.vertices, split.faces)
    np.testing.assert_array_equal(joined.vertices, whole.vertices)
    np.testing.assert_array_equal(joined.faces, whole.faces)
    np.testing.assert_array_equal(kept, np.arange(whole.n_vertices))


@pytest.mark.parametrize(("apart", "joined"), [(1e-6, True), (0.005, True), (0.03, False)])
def test_edges_are_joined_that_are_no_farther_apart_than_files_round(apart, joined):
    sheet = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1.0 + apart, 0, 0], [1, 1, 0], [0, 1, apart]], [[0, 1, 2], [3, 4, 5]])
    assert sheet.split_edges == (2 if joined else 0)
    assert Mesh.cleaned(sheet.vertices, sheet.faces)[0].n_vertices == (4 if joined else 6)


def test_vertices_that_are_near_off_the_open_edges_stay():
    """As those of a fold."""
    flat = tube()
    pressed = flat.vertices * [1.0, 1.0, 1e-6]
    assert Mesh.cleaned(pressed, flat.faces)[0].n_vertices >= np.count_nonzero(~flat.boundary_vertices)

"""Closest points against brute force, and the side of the body by the winding number."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf.body import proximity
from ddakf.mesh import Mesh
from tests.physics.shapes import ball, rotation, sheet

EXACT = 1e-12  # m
SEEDS = st.integers(0, 2**32 - 1)
BALL = ball(2)


def dented(seed) -> Mesh:
    """A closed body with bumps, dents and thin places."""
    shape = np.random.default_rng(seed).uniform(0.5, 1.2, (BALL.n_vertices, 1))
    return Mesh(BALL.vertices * shape, BALL.faces)


def query(mesh, points, radius=10.0, pose=None, hint=None):
    body = proximity.build(mesh)
    surface = proximity.refresh(body, mesh.vertices if pose is None else pose)
    return body, proximity.closest_points(body, surface, np.atleast_2d(points).astype(float), radius, hint)


def brute_force(vertices, faces, points):
    """Distance to the nearest triangle: the plane where the foot lies inside, else the nearest of three segments."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    best = np.full(len(points), np.inf)
    for p, q in [(a, b), (b, c), (c, a)]:
        edge = q - p
        t = np.einsum("nfa,fa->nf", points[:, None] - p, edge) / np.einsum("fa,fa->f", edge, edge)
        foot = p + np.clip(t, 0.0, 1.0)[..., None] * edge
        best = np.minimum(best, np.linalg.norm(points[:, None] - foot, axis=2).min(axis=1))
    normal = np.cross(b - a, c - a)
    height = np.einsum("nfa,fa->nf", points[:, None] - a, normal) / np.einsum("fa,fa->f", normal, normal)
    foot = points[:, None] - height[..., None] * normal
    inside = np.ones(height.shape, bool)
    for p, q in [(a, b), (b, c), (c, a)]:
        inside &= np.einsum("nfa,fa->nf", np.cross(q - p, foot - p), normal) >= 0.0
    plane = np.where(inside, np.linalg.norm(points[:, None] - foot, axis=2), np.inf)
    return np.minimum(best, plane.min(axis=1))


def winding_number(vertices, faces, points):
    """Solid angle of the surface over 4 pi: 1 inside, 0 outside (van Oosterom and Strackee 1983)."""
    a, b, c = (vertices[faces[:, corner]] - points[:, None] for corner in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
    determinant = np.einsum("nfa,nfa->nf", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("nfa,nfa->nf", x, y) for x, y in [(a, b), (b, c), (c, a)])
    return np.arctan2(determinant, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2 * np.pi)


@given(seed=SEEDS)
@settings(max_examples=25, deadline=None)
def test_distance_side_and_foot(seed):
    mesh = dented(seed)
    points = np.random.default_rng(seed).uniform(-0.3, 0.3, (60, 3))
    body, contact = query(mesh, points)
    np.testing.assert_allclose(np.abs(contact.distance), brute_force(mesh.vertices, mesh.faces, points), atol=EXACT)
    inside = winding_number(mesh.vertices, mesh.faces, points) > 0.5
    np.testing.assert_array_equal(contact.distance < 0.0, inside)
    np.testing.assert_allclose(points, contact.point + contact.distance[:, None] * contact.normal, atol=EXACT)
    np.testing.assert_allclose(np.linalg.norm(contact.normal, axis=1), 1.0)
    corners = mesh.vertices[mesh.faces[body.original_face[contact.face]]]
    np.testing.assert_allclose(np.einsum("nc,nca->na", contact.barycentric, corners), contact.point, atol=EXACT)
    np.testing.assert_allclose(contact.barycentric.sum(axis=1), 1.0)
    assert contact.barycentric.min() >= -EXACT


@given(seed=SEEDS)
@settings(max_examples=15, deadline=None)
def test_another_pose_a_wrong_hint_and_a_shift_change_nothing(seed):
    mesh = dented(seed)
    rng = np.random.default_rng(seed)
    pose = (dented(seed + 1).vertices + 0.1) @ rotation(seed).T  # the tree was shaped by quite another body
    points = rng.uniform(-0.5, 0.5, (40, 3))
    hint = rng.integers(-1, mesh.n_faces, len(points)).astype(np.int32)
    _, contact = query(mesh, points, pose=pose, hint=hint)
    for with_hint, without in zip(contact, query(mesh, points, pose=pose)[1], strict=True):
        np.testing.assert_array_equal(with_hint, without)
    np.testing.assert_allclose(np.abs(contact.distance), brute_force(pose, mesh.faces, points), atol=EXACT)


@given(seed=SEEDS, radius=st.floats(0.001, 0.2))
@settings(max_examples=15, deadline=None)
def test_radius_cuts_off_and_does_nothing_else(seed, radius):
    mesh, points = dented(seed), np.random.default_rng(seed).uniform(-0.3, 0.3, (40, 3))
    distance = brute_force(mesh.vertices, mesh.faces, points)
    _, contact = query(mesh, points, radius)
    np.testing.assert_array_equal(contact.face >= 0, distance < radius)
    found = contact.face >= 0
    np.testing.assert_allclose(np.abs(contact.distance[found]), distance[found], atol=EXACT)
    assert np.isinf(contact.distance[~found]).all()
    assert not contact.normal[~found].any()
    assert not contact.barycentric[~found].any()


def test_points_on_vertices_edges_and_faces():
    corners = BALL.vertices[BALL.faces[:20]]
    points = np.concatenate([corners[:, 0], corners[:, :2].mean(axis=1), corners.mean(axis=1)])
    _, contact = query(BALL, points)
    np.testing.assert_allclose(contact.distance, 0.0, atol=EXACT)
    outward = np.einsum("na,na->n", contact.normal, points / np.linalg.norm(points, axis=1, keepdims=True))
    assert outward.min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(contact.normal, axis=1), 1.0)


def test_ties_do_not_depend_on_the_order_of_the_search():
    """Above vertices and edges several faces are equally near, but for rounding."""
    ends = BALL.vertices[BALL.edges]
    points = 1.3 * np.concatenate([BALL.vertices, ends.mean(axis=1)])
    _, expected = query(BALL, points)
    rng = np.random.default_rng(0)
    for _ in range(10):
        order = rng.permutation(len(points))
        hint = rng.integers(-1, BALL.n_faces, len(points)).astype(np.int32)
        _, contact = query(BALL, points[order], hint=hint)
        np.testing.assert_array_equal(contact.face, expected.face[order])


def test_sign_beyond_a_sharp_edge_and_a_sharp_corner():
    """A thin wedge, where the normal of one adjacent face alone would give the wrong side."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.02], [0, 1, -0.02]], float)
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
    centroid = vertices.mean(axis=0)
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    if np.einsum("fa,fa->", normals, vertices[faces].mean(axis=1) - centroid) < 0:
        faces = faces[:, ::-1]
    around = np.random.default_rng(0).normal(size=(400, 3))
    points = vertices[np.arange(400) % 4] + 0.1 * around / np.linalg.norm(around, axis=1, keepdims=True)
    _, contact = query(Mesh(vertices, faces), points)
    inside = winding_number(vertices, faces, points) > 0.5
    np.testing.assert_array_equal(contact.distance < 0.0, inside)


def test_an_open_body_has_contacts_too():
    _, contact = query(sheet(), sheet().vertices + np.array([0.0, 0.0, 0.003]))
    assert (contact.face >= 0).all()
    assert np.abs(contact.distance).max() <= 0.003 + EXACT


def test_beyond_the_rim_of_an_open_body_nothing_is_inside():
    """As below a torso: the faces at its rim have an inside there, and their planes go on for ever."""
    whole = ball()
    top = whole.faces[(whole.vertices[whole.faces][:, :, 1] > 0.0).all(axis=1)]
    used, numbers = np.unique(top, return_inverse=True)
    half = Mesh(whole.vertices[used], numbers.reshape(top.shape))
    rng = np.random.default_rng(0)
    below = rng.uniform(-1.0, 1.0, (400, 3)) * np.ptp(half.vertices, axis=0).max()
    below[:, 1] = half.vertices[:, 1].min() - np.ptp(half.vertices[:, 1]) - np.abs(below[:, 1])
    _, contact = query(half, below)
    assert (contact.distance >= 0.0).all()
    inward = half.vertices[~half.boundary_vertices]
    _, contact = query(half, 0.98 * (inward - whole.vertices.mean(axis=0)) + whole.vertices.mean(axis=0))
    assert (contact.distance < 0.0).mean() > 0.8


@pytest.mark.parametrize("n_faces", [1, 2, 8, 9, 16, 17, 100, 512])
def test_bodies_of_any_size(n_faces):
    mesh, _ = Mesh.cleaned(ball(3).vertices, ball(3).faces[:n_faces])
    points = np.random.default_rng(n_faces).uniform(-0.3, 0.3, (30, 3))
    _, contact = query(mesh, points)
    np.testing.assert_allclose(np.abs(contact.distance), brute_force(mesh.vertices, mesh.faces, points), atol=EXACT)


@pytest.mark.parametrize("collapse", ["point", "line", "half"])
def test_a_collapsed_body_stays_finite(collapse):
    pose = BALL.vertices.copy()
    if collapse == "half":
        pose[pose[:, 0] > 0] = [0.1, 0.0, 0.0]
    else:
        pose[:, {"point": 0, "line": 1}[collapse] :] = 0.0
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    _, contact = query(BALL, points, pose=pose)
    assert (contact.face >= 0).all()
    assert all(np.isfinite(array).all() for array in contact)
    assert (np.abs(contact.distance) <= np.linalg.norm(points[:, None] - pose, axis=2).min(axis=1) + EXACT).all()


def test_a_hint_of_another_pose_changes_no_result():
    body = proximity.build(BALL)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    first = proximity.closest_points(body, proximity.refresh(body, BALL.vertices), points, 1.0)
    moved = proximity.refresh(body, BALL.vertices + 0.05)
    again = proximity.closest_points(body, moved, points, 1.0, first.face)
    for array, fresh in zip(again, proximity.closest_points(body, moved, points, 1.0), strict=True):
        np.testing.assert_array_equal(array, fresh)


def test_adjacency():
    mesh = sheet()
    body = proximity.build(mesh)
    for f, face in enumerate(body.faces):
        np.testing.assert_array_equal(face, mesh.faces[body.original_face[f]])
        for c in range(3):
            ends = {face[c], face[(c + 1) % 3]}
            others = [g for g, other in enumerate(body.faces) if g != f and ends <= set(other)]
            assert others == ([body.neighbour[f, c]] if body.neighbour[f, c] >= 0 else [])
    for v in range(mesh.n_vertices):
        ring = body.ring_face[body.ring_start[v] : body.ring_start[v + 1]]
        assert set(ring) == set(np.flatnonzero((body.faces == v).any(axis=1)))

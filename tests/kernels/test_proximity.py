"""Parts of the proximity search and of the surface's motion against NumPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ddakf.body import proximity as proximity_stage
from ddakf.kernels import proximity, surface_motion
from ddakf.mesh import Mesh
from tests.physics.shapes import ball


def slow_closest(p, b, c):
    """Distance to a triangle at the origin by a fine grid of its points, good to the grid's spacing."""
    steps = np.linspace(0.0, 1.0, 101)
    v, w = (grid.ravel() for grid in np.meshgrid(steps, steps))
    v, w = v[v + w <= 1.0 + 1e-9], w[v + w <= 1.0 + 1e-9]
    return np.linalg.norm(p - v[:, None] * b - w[:, None] * c, axis=1).min()


def test_closest_on_triangle():
    rng = np.random.default_rng(0)
    for p, b, c in rng.normal(size=(200, 3, 3)):
        v, w = proximity.closest_on_triangle(tuple(p), tuple(b), tuple(c))
        assert min(v, w) >= 0.0
        assert v + w <= 1.0 + 1e-12
        distance = np.linalg.norm(p - v * b - w * c)
        assert distance <= slow_closest(p, b, c) + 1e-12
        assert distance >= slow_closest(p, b, c) - 0.03


def test_closest_on_triangles_without_area():
    """Two corners in one place, in every way, or all three: the distance to what is left."""
    rng = np.random.default_rng(1)
    zero = np.zeros(3)
    for p, e in rng.normal(size=(100, 2, 3)):
        segment = np.linalg.norm(p - np.clip(p @ e / (e @ e), 0.0, 1.0) * e)
        for b, c in [(e, e), (e, zero), (zero, e)]:
            v, w = proximity.closest_on_triangle(tuple(p), tuple(b), tuple(c))
            np.testing.assert_allclose(np.linalg.norm(p - v * b - w * c), segment, atol=1e-12)
        assert proximity.closest_on_triangle(tuple(p), tuple(zero), tuple(zero)) == (0.0, 0.0)


def random_faces(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(20, 3))
    return rng, vertices, np.stack([rng.permutation(20)[:3] for _ in range(16)]).astype(np.int32)


def test_leaf_distances_agree_with_the_triangle():
    rng, vertices, faces = random_faces(2)
    faces[5] = faces[5, [0, 0, 1]]  # and one without an area
    triangles, boxes = np.zeros((2, 15, 8)), np.zeros((1, 6, 8))
    proximity.refit(vertices, faces, np.array([0, 8, 16], np.int32), 2 - 7, triangles, boxes)
    squared = np.empty(8)
    for p in rng.normal(size=(50, 3)):
        for leaf in range(2):
            proximity.leaf_distances(triangles, leaf, *p, squared)
            for lane in range(8):
                a, b, c = vertices[faces[8 * leaf + lane]]
                v, w = proximity.closest_on_triangle(tuple(p - a), tuple(b - a), tuple(c - a))
                expected = np.sum((p - a - v * (b - a) - w * (c - a)) ** 2)
                np.testing.assert_allclose(squared[lane], expected, atol=1e-12)


def test_boxes_hold_their_faces_and_empty_ones_are_far():
    rng, vertices, faces = random_faces(3)
    triangles, boxes = np.zeros((2, 15, 8)), np.zeros((1, 6, 8))
    proximity.refit(vertices, faces, np.array([0, 8, 16], np.int32), 2 - 7, triangles, boxes)
    corners = vertices[faces].reshape(2, 24, 3)
    np.testing.assert_allclose(boxes[0, :3, 6:].T, corners.min(axis=1))
    np.testing.assert_allclose(boxes[0, 3:, 6:].T, corners.max(axis=1))
    squared = np.empty(8)
    p = 5.0 * rng.normal(size=3)
    proximity.box_distances(boxes[0], 8, *p, squared)
    nearest = np.clip(p, corners.min(axis=1), corners.max(axis=1))
    np.testing.assert_allclose(squared[6:], np.sum((p - nearest) ** 2, axis=1))
    assert squared[:6].min() > 1e50


def slow_side(mesh, face, coordinates, d):
    """d . pseudo-normal (Baerentzen and Aanaes 2005) at a point of a face: the sum of the unit normals of all faces that the
    point lies on, around a corner weighted with their angles."""
    on = [corner for corner, share in zip(mesh.faces[face], coordinates, strict=True) if share > 1e-9]
    total = np.zeros(3)
    for corners in mesh.faces[np.isin(mesh.faces, on).sum(axis=1) == len(on)]:
        a, b, c = mesh.vertices[corners]
        normal, angle = np.cross(b - a, c - a), 1.0
        if len(on) == 1:
            k = list(corners).index(on[0])
            p, q = (mesh.vertices[corners[(k + j) % 3]] - mesh.vertices[on[0]] for j in (1, 2))
            angle = np.arccos(p @ q / np.linalg.norm(p) / np.linalg.norm(q))
        total += angle * normal / np.linalg.norm(normal)
    return total @ d


@pytest.mark.parametrize("kind", ["inside", "edge", "corner"])
def test_outside_is_the_side_of_the_pseudo_normal(kind):
    """In all directions from points of a crumpled body, those in which the faces around disagree among them."""
    rng = np.random.default_rng(5)
    smooth = ball(1)
    mesh = Mesh(smooth.vertices * rng.uniform(0.4, 1.6, (smooth.n_vertices, 1)), smooth.faces)
    body = proximity_stage.build(mesh)
    faces = mesh.vertices, body.faces, body.neighbour, body.ring_start, body.ring_face
    disagreed = told = 0
    for face in range(len(body.faces)):
        for turn in range(3):
            shares = {"inside": rng.dirichlet([2, 2, 2]), "edge": [0.0, *rng.dirichlet([2, 2])], "corner": [1.0, 0.0, 0.0]}[kind]
            u, v, w = np.roll(shares, turn)
            for d in rng.normal(size=(20, 3)):
                expected = slow_side(mesh, body.original_face[face], (u, v, w), d)
                if abs(expected) < 1e-9:
                    continue
                told += 1
                disagreed += (proximity.side_of_face(mesh.vertices, body.faces, face, tuple(d)) > 0) != (expected > 0)
                assert proximity.outside(*faces, face, (u, v, w), tuple(d)) == (expected > 0)
    assert told > 1000
    assert (disagreed > 50) == (kind != "inside")


def test_quaternion_of_every_kind_of_rotation():
    """Random ones, and turns by 180 degrees, where the trace is at its least."""
    turns = [*Rotation.random(50, random_state=0), *(Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3))]
    frame = Rotation.random(random_state=1).as_matrix()
    for turn in turns:
        moved = turn.as_matrix() @ frame
        w, x, y, z = surface_motion.quaternion(*(tuple(column) for column in [*frame.T, *moved.T]))
        assert abs(np.dot(turn.as_quat(scalar_first=True), (w, x, y, z))) > 1.0 - 1e-12


def test_rotation_of_a_face_is_the_polar_factor():
    """One face, deformed at random: the orthogonal factor of its deformation, normal to normal."""
    rng = np.random.default_rng(4)
    faces = np.array([[0, 1, 2]], np.int32)
    for _ in range(20):
        last, now = rng.normal(size=(2, 3, 3))
        edges = [np.stack([x[1] - x[0], x[2] - x[0]], axis=1) for x in (last, now)]
        normals = [np.cross(*e.T) / np.linalg.norm(np.cross(*e.T)) for e in edges]
        deformation = np.column_stack([edges[1], normals[1]]) @ np.linalg.inv(np.column_stack([edges[0], normals[0]]))
        u, _, vt = np.linalg.svd(deformation)
        rotation, needed = np.empty((3, 4)), np.empty(3, np.uint8)
        surface_motion.vertex_rotations(last, now, faces, np.array([0], np.int32), needed, rotation)
        for quaternion in rotation:
            np.testing.assert_allclose(Rotation.from_quat(quaternion, scalar_first=True).as_matrix(), u @ vt, atol=1e-9)


def test_pseudo_normals_of_a_corner_an_edge_and_a_face():
    """Unit normals: alone, the sum of two, and around a corner weighted by the angle there."""
    rng = np.random.default_rng(5)
    vertices = rng.normal(size=(4, 3))
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1]], np.int32)
    neighbour = np.array([[2, -1, 1], [0, -1, 2], [1, -1, 0]], np.int32)
    ring_start, ring_face = np.array([0, 3, 5, 7, 9], np.int32), np.array([0, 1, 2, 0, 2, 0, 1, 1, 2], np.int32)

    def normal(f, *coordinates):
        return proximity.pseudo_normal(vertices, faces, neighbour, ring_start, ring_face, f, coordinates)

    edges = vertices[faces[:, 1:]] - vertices[0]
    units = np.cross(edges[:, 0], edges[:, 1])
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    edges /= np.linalg.norm(edges, axis=2, keepdims=True)
    angles = np.arccos(np.einsum("fa,fa->f", edges[:, 0], edges[:, 1]))
    np.testing.assert_allclose(normal(1, 0.2, 0.3, 0.5), units[1])
    np.testing.assert_allclose(normal(0, 0.4, 0.6, 0.0), units[0] + units[2])
    np.testing.assert_allclose(normal(0, 0.4, 0.0, 0.6), units[0] + units[1])
    np.testing.assert_allclose(normal(0, 0.0, 0.4, 0.6), units[0])
    np.testing.assert_allclose(normal(2, 1.0, 0.0, 0.0), angles @ units)

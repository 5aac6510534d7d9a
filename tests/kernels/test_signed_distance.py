"""Signs and pseudo-normals against sums over the faces around a point."""

import numpy as np
import pytest

from ddakf.body import proximity
from ddakf.kernels import signed_distance
from ddakf.mesh import Mesh
from tests.physics.shapes import ball


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
    body = proximity.build(mesh)
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
                disagreed += (signed_distance.side_of_face(mesh.vertices, body.faces, face, tuple(d)) > 0) != (expected > 0)
                assert signed_distance.outside(*faces, face, (u, v, w), tuple(d)) == (expected > 0)
    assert told > 1000
    assert (disagreed > 50) == (kind != "inside")


def test_pseudo_normals_of_a_corner_an_edge_and_a_face():
    """Unit normals: alone, the sum of two, and around a corner weighted by the angle there."""
    rng = np.random.default_rng(5)
    vertices = rng.normal(size=(4, 3))
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1]], np.int32)
    neighbour = np.array([[2, -1, 1], [0, -1, 2], [1, -1, 0]], np.int32)
    ring_start, ring_face = np.array([0, 3, 5, 7, 9], np.int32), np.array([0, 1, 2, 0, 2, 0, 1, 1, 2], np.int32)

    def normal(f, *coordinates):
        return signed_distance.pseudo_normal(vertices, faces, neighbour, ring_start, ring_face, f, coordinates)

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

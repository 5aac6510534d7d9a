"""Parts of the proximity search against NumPy."""

import numpy as np

from ddakf.kernels import proximity
from ddakf.kernels import triangles as geometry


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
                v, w = geometry.closest_on_triangle(tuple(p - a), tuple(b - a), tuple(c - a))
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


def test_the_first_of_equally_near_faces_in_the_lanes():
    """Leaves of five, seven and eight faces, in any order; few different numbers make many ties."""
    rng, start, lanes = np.random.default_rng(6), np.array([0, 5, 12, 20], np.int32), np.arange(8)
    for _ in range(200):
        distance = rng.integers(0, 20, 20).astype(float)
        squared, leaf = np.full(8, np.inf), np.zeros(8, np.int64)
        for number in rng.permutation(3):
            faces = np.minimum(start[number] + lanes, start[number + 1] - 1)  # the spare lanes repeat the last face
            proximity.keep_nearer(distance[faces], number, squared, leaf)
        assert proximity.least_of(squared) == distance.min()
        assert proximity.first_face(start, squared, leaf, distance.min()) == distance.argmin()

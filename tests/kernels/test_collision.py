"""The collision kernel against NumPy."""

import numpy as np

from ddakf.kernels import collision
from ddakf.kernels.signed_distance import Contact


def test_agrees_with_the_formula():
    rng = np.random.default_rng(0)
    n, gap = 40, rng.uniform(-0.2, 0.2, 40)
    x, q, normal = rng.normal(size=(3, n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    face, area = rng.integers(-1, 2, n).astype(np.int32), rng.uniform(1.0, 2.0, n)
    residual, jacobian, weight = np.full(n, np.nan), np.full((n, 1, 3), np.nan), np.full(n, np.nan)
    contact = Contact(face, np.zeros((n, 3)), q, normal, np.zeros(n))
    yielding = rng.uniform(0.0, 1.0, n)
    collision.linearize(x, contact, gap, area, yielding, residual, jacobian, weight)
    depth = np.where(face >= 0, np.einsum("va,va->v", normal, x - q) - gap, 0.0)
    touching = depth < 0.0
    np.testing.assert_allclose(residual, np.minimum(0.0, depth), atol=1e-12)
    np.testing.assert_array_equal(weight, np.where(touching, area / (1.0 + yielding * area), 0.0))
    np.testing.assert_array_equal(jacobian[:, 0], np.where(touching[:, None], normal, 0.0))
    assert 0 < touching.sum() < n


def test_vertices_near_the_body_and_their_new_contacts():
    rng, n = np.random.default_rng(1), 50
    x, asked_at = rng.normal(size=(2, n, 3))
    distance = np.where(rng.random(n) < 0.2, np.inf, rng.uniform(-1.0, 4.0, n))
    contact = Contact(rng.integers(-1, 9, n).astype(np.int32), *rng.normal(size=(3, n, 3)), distance)
    expected = np.flatnonzero(distance - np.linalg.norm(x - asked_at, axis=1) < 0.1)
    near, points, face = np.empty(n, np.uint32), np.empty((n, 3)), np.empty(n, np.int32)
    count = collision.near_body(x, asked_at, contact, 0.1, near, points, face)
    assert 0 < count < n
    for array, right in ((near, expected), (points, x[expected]), (face, contact.face[expected])):
        np.testing.assert_array_equal(array[:count], right)
    found = Contact(face[:count] + 1, *rng.normal(size=(3, count, 3)), rng.normal(size=count))
    right = [array.copy() for array in (*contact, asked_at)]
    for array, new in zip(right, (*found, points[:count]), strict=True):
        array[expected] = new
    collision.replace_contacts(near[:count], points[:count], found, contact, asked_at)
    for array, new in zip((*contact, asked_at), right, strict=True):
        np.testing.assert_array_equal(array, new)

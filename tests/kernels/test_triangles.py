"""Closest points on triangles against a fine grid."""

import numpy as np

from ddakf.kernels import triangles


def slow_closest(p, b, c):
    """Distance to a triangle at the origin by a fine grid of its points, good to the grid's spacing."""
    steps = np.linspace(0.0, 1.0, 101)
    v, w = (grid.ravel() for grid in np.meshgrid(steps, steps))
    v, w = v[v + w <= 1.0 + 1e-9], w[v + w <= 1.0 + 1e-9]
    return np.linalg.norm(p - v[:, None] * b - w[:, None] * c, axis=1).min()


def test_closest_on_triangle():
    rng = np.random.default_rng(0)
    for p, b, c in rng.normal(size=(200, 3, 3)):
        v, w = triangles.closest_on_triangle(tuple(p), tuple(b), tuple(c))
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
            v, w = triangles.closest_on_triangle(tuple(p), tuple(b), tuple(c))
            np.testing.assert_allclose(np.linalg.norm(p - v * b - w * c), segment, atol=1e-12)
        assert triangles.closest_on_triangle(tuple(p), tuple(zero), tuple(zero)) == (0.0, 0.0)

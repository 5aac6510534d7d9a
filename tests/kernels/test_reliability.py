"""Sums over the vertices against NumPy."""

import numpy as np
import pytest

from ddakf.kernels import reliability
from tests.stages.scenes import blocks


def scene(seed, n=50):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3))
    return rng, normal / np.linalg.norm(normal, axis=1, keepdims=True), blocks(n, 3, rng)


@pytest.mark.parametrize("seed", range(5))
def test_variance_along_normals(seed):
    _, normal, P = scene(seed)
    expected = np.einsum("va,vab,vb->", normal, P, normal)
    assert reliability.variance_along(normal, P) == pytest.approx(expected, rel=1e-12)
    assert reliability.variance_along(normal, np.tile(np.eye(3), (len(P), 1, 1))) == pytest.approx(len(P))
    assert reliability.variance_along(np.zeros_like(normal), P) == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_squared_innovations_of_what_was_found(seed):
    rng, _, R = scene(seed)
    y, found = rng.normal(size=(len(R), 3)), rng.random(len(R)) < 0.6
    expected = (np.square(y).sum(axis=1) / np.trace(R, axis1=1, axis2=2))[found].sum()
    assert reliability.squared_innovations(y, R, found) == pytest.approx(expected, rel=1e-12)
    y[~found], R[~found] = np.nan, 0.0  # rows without a measurement hold anything
    assert reliability.squared_innovations(y, R, found) == pytest.approx(expected, rel=1e-12)
    assert reliability.squared_innovations(y, R, np.zeros(len(R), bool)) == 0.0

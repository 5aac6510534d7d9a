"""Sums over the vertices against NumPy."""

import numpy as np
import pytest

from ddakf.kernels import reliability
from tests.stages.scenes import blocks


@pytest.mark.parametrize("seed", range(5))
def test_squared_innovations_of_what_was_found(seed):
    rng = np.random.default_rng(seed)
    R = blocks(50, 3, rng)
    y, found = rng.normal(size=(len(R), 3)), rng.random(len(R)) < 0.6
    expected = (np.square(y).sum(axis=1) / np.trace(R, axis1=1, axis2=2))[found].sum()
    assert reliability.squared_innovations(y, R, found) == pytest.approx(expected, rel=1e-12)
    y[~found], R[~found] = np.nan, 0.0  # rows without a measurement hold anything
    assert reliability.squared_innovations(y, R, found) == pytest.approx(expected, rel=1e-12)
    assert reliability.squared_innovations(y, R, np.zeros(len(R), bool)) == 0.0

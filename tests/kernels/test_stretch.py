"""The stretch kernel against NumPy."""

import numpy as np
import pytest

from ddakf.kernels import stretch


def slow(x, stencil, coefficient):
    w = np.einsum("cs,csa->ca", coefficient, x[stencil])
    length = np.linalg.norm(w, axis=1)
    unit = np.divide(w, length[:, None], out=np.zeros_like(w), where=length[:, None] > 1e-12)
    return length - 1.0, coefficient[:, :, None] * unit[:, None]


@pytest.mark.parametrize("degenerate", [False, True])
def test_agrees_with_the_formula(degenerate):
    rng = np.random.default_rng(0)
    x, stencil = rng.normal(size=(30, 3)), rng.integers(0, 30, (50, 3)).astype(np.int32)
    coefficient = rng.normal(size=(50, 3)) * 50.0
    if degenerate:
        coefficient[:, 0] = -coefficient[:, 1] - coefficient[:, 2]
        x[:] = x[0]
    residual, jacobian = np.full(50, np.nan), np.full((50, 3, 3), np.nan)
    stretch.linearize(x, stencil, coefficient, residual, jacobian)
    expected = slow(x, stencil, coefficient)
    np.testing.assert_allclose(residual, expected[0], atol=1e-12)
    np.testing.assert_allclose(jacobian, np.zeros((50, 3, 3)) if degenerate else expected[1], atol=1e-10)

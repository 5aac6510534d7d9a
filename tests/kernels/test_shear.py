"""The shear kernel against NumPy."""

import numpy as np

from ddakf.kernels import shear


def test_agrees_with_the_formula():
    rng = np.random.default_rng(0)
    x, stencil = rng.normal(size=(30, 3)), rng.integers(0, 30, (50, 3)).astype(np.int32)
    warp, weft = rng.normal(size=(2, 50, 3)) * 50.0
    residual, jacobian = np.full(50, np.nan), np.full((50, 3, 3), np.nan)
    shear.linearize(x, stencil, warp, weft, residual, jacobian)
    wu, wv = (np.einsum("cs,csa->ca", coefficient, x[stencil]) for coefficient in (warp, weft))
    np.testing.assert_allclose(residual, np.einsum("ca,ca->c", wu, wv))
    np.testing.assert_allclose(jacobian, warp[:, :, None] * wv[:, None] + weft[:, :, None] * wu[:, None])

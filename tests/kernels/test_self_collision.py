"""The search for other layers against NumPy, and the assembly of its pairs."""

import numpy as np
import pytest

from ddakf.kernels import self_collision


def slow_opposite(x, normal, rest, reach, apart):
    """All pairs."""
    d = x[:, None] - x
    squared = (d**2).sum(axis=2)
    height = np.einsum("ja,ija->ij", normal, d)
    allowed = (squared < reach**2) & (((rest[:, None] - rest) ** 2).sum(axis=2) >= apart**2)
    allowed &= squared - height**2 <= 0.5625 * reach**2
    np.fill_diagonal(allowed, False)
    partner = np.where(allowed.any(axis=1), np.where(allowed, squared, np.inf).argmin(axis=1), -1)
    side = np.where(height[np.arange(len(x)), partner] >= 0, 1.0, -1.0)
    return partner, np.where(partner >= 0, side, 0.0)


@pytest.mark.parametrize("stray", [0.0, 50.0], ids=["compact", "with a stray vertex"])
@pytest.mark.parametrize("reach", [0.05, 0.2, 3.0])
def test_opposite_agrees_with_all_pairs(reach, stray):
    rng = np.random.default_rng(1)
    x, rest, normal = rng.uniform(size=(3, 300, 3))
    normal = (normal - 0.5) / np.linalg.norm(normal - 0.5, axis=1, keepdims=True)
    x[7] += stray
    partner, side = np.empty(300, np.int32), np.empty(300)
    self_collision.find_opposite(x, normal, rest, reach, 0.4, partner, side)
    expected = slow_opposite(x, normal, rest, reach, 0.4)
    np.testing.assert_array_equal(partner, expected[0])
    np.testing.assert_array_equal(side, expected[1])
    assert (partner >= 0).any()


def test_pairs_are_added_like_the_formula_with_twice_the_blocks():
    rng = np.random.default_rng(2)
    stencil = np.array([[0, 3], [1, 3], [2, 0]], np.int32)
    residual, weight, jacobian = rng.normal(size=3), np.array([1.0, 0.0, 2.0]), rng.normal(size=(3, 2, 3))
    D, force = np.zeros((4, 3, 3)), np.zeros((4, 4))
    self_collision.add_pairs(stencil, residual, jacobian, weight, 5.0, D, force)
    full, right = np.zeros((12, 12)), np.zeros(12)
    for c in range(3):
        row = np.zeros(12)
        for s in range(2):
            row[3 * stencil[c, s] :][:3] += jacobian[c, s]
        full += 5.0 * weight[c] * np.outer(row, row)
        right -= 5.0 * weight[c] * residual[c] * row
    np.testing.assert_allclose(force[:, :3].ravel(), right)
    majorant = np.zeros((12, 12))
    for i in range(4):
        np.testing.assert_allclose(D[i], 2.0 * full[3 * i : 3 * i + 3, 3 * i : 3 * i + 3])
        majorant[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = D[i]
    assert np.linalg.eigvalsh(majorant - full).min() > -1e-12

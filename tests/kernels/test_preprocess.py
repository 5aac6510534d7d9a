"""Planes of neighbourhoods against NumPy's eigenvectors."""

import numpy as np
import pytest

from ddakf.kernels.preprocess import BLOCK, planes_of

RADIUS = 0.03  # m
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
KINDS = ("surface", "line", "ball", "point", "two points", "three points")


def neighbourhood(kind, rng):
    """Weighted points about the origin, where the point itself is; metres."""
    n = int(rng.integers(6, 60))
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    if kind == "ball":
        points = rng.normal(size=(2000, 3))
        points *= RADIUS * rng.random((2000, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    elif kind == "surface":
        points = rng.uniform(-0.6, 0.6, (n, 3)) * RADIUS * [1.0, 1.0, 0.1] @ frame
    elif kind == "line":
        points = rng.uniform(-0.9, 0.9, (n, 1)) * RADIUS * frame[:1]
    else:
        others = {"point": 0, "two points": 1, "three points": 2}[kind]
        points = rng.uniform(-0.5, 0.5, (others, 3)) * RADIUS
    points = np.concatenate([np.zeros((1, 3)), points])
    return points, np.maximum(1.0 - np.square(points).sum(axis=1) / RADIUS**2, 0.0) ** 2


def moments_of(points, weight):
    """The ten sums, rounded as the kernel gets them."""
    second = np.einsum("n,na,nb->ab", weight, points, points)
    return np.array([weight.sum(), *(weight @ points), *(second[a, b] for a, b in PAIRS)], np.float32)


def slow_plane(moments):
    """Distance and normal of the plane; zero where the weighted covariance has no one thin direction, or only one thick one."""
    w, mean, C = float(moments[0]), moments[1:4].astype(float), np.empty((3, 3))
    for (a, b), value in zip(PAIRS, moments[4:].astype(float), strict=True):
        C[a, b] = C[b, a] = value / w - mean[a] * mean[b] / w**2
    values, vectors = np.linalg.eigh(C)
    if values[1] <= 0.004 * RADIUS**2 or values[0] >= 0.5 * values[1]:
        return 0.0, np.zeros(3)
    return vectors[:, 0] @ mean / w, vectors[:, 0]


@pytest.mark.parametrize("n", [1, 7, BLOCK])
def test_planes_are_those_of_the_least_eigenvector(n):
    rng = np.random.default_rng(n)
    kinds = [KINDS[0] if i == 0 else KINDS[i % len(KINDS)] for i in range(n)]
    rows = np.array([moments_of(*neighbourhood(kind, rng)) for kind in kinds])
    block = np.ones((10, BLOCK), np.float32)
    block[:, :n] = rows.T
    moments = block.ravel().copy()
    planes_of(moments, n, RADIUS**2)
    got = moments.reshape(10, BLOCK)[:4].T
    np.testing.assert_array_equal(got[n:], 1.0)  # others' are left alone
    spanned = 0
    for kind, row, (offset, *normal) in zip(kinds, rows, got[:n], strict=True):
        expected, direction = slow_plane(row)
        spanned += bool(direction.any())
        sign = 1.0 if direction @ normal >= 0.0 else -1.0
        np.testing.assert_allclose(sign * np.array(normal), direction, atol=2e-5, err_msg=kind)
        assert sign * offset == pytest.approx(expected, abs=1e-6 * RADIUS)
        assert kind == "surface" or kind == "three points" or not any(normal), kind
    assert spanned >= n // len(KINDS)

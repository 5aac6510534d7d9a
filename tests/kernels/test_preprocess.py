"""Planes of neighbourhoods and distances to neighbours against slow twins."""

import numpy as np
import pytest

from ddakf.kernels.preprocess import BLOCK, Grid, fill_grid, knn_mean_distances, planes_of

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


@pytest.mark.parametrize("kind", ["scattered", "in pairs", "all in one place", "clump and strays"])
@pytest.mark.parametrize(("n", "k"), [(1, 3), (4, 3), (9, 15), (17, 16), (400, 15), (400, 1)])
def test_mean_distances_are_those_of_sorted_ones(kind, n, k):
    rng = np.random.default_rng(n + k)
    points = rng.random((n, 3)).astype(np.float32)
    if kind == "in pairs":
        points[1::2] = points[: n // 2 * 2 : 2]
    elif kind == "all in one place":
        points[:] = 0.5
    elif kind == "clump and strays":
        points[: n // 2] *= 0.01
    grid = Grid(np.empty(6 * 5 * 7 + 2, np.int32), np.zeros(3), 0.21, np.array([6, 5, 7]))
    ordered, index, mean = np.empty((3, n), np.float32), np.empty(n, np.int32), np.empty(n)
    fill_grid(points.astype(float), np.arange(n, dtype=np.int32), grid, ordered, index)
    knn_mean_distances(ordered, np.arange(n), grid, k, 6, mean)
    apart = np.linalg.norm(ordered.T[:, None].astype(float) - ordered.T[None], axis=2)
    known = np.sort(apart, axis=1)[:, 1 : k + 1].mean(axis=1) if n > 1 else np.zeros(1)
    if n > k:
        np.testing.assert_allclose(mean, known, rtol=1e-5, atol=1e-9)
    else:  # fewer neighbours than are asked for: the searched distance counts
        assert (mean >= np.maximum(known * (1.0 - 1e-5), 6 * 0.21)).all()
        assert np.isfinite(mean).all()

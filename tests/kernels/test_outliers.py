"""Mean distances to neighbours against sorted ones."""

import numpy as np
import pytest

from ddakf.kernels.outliers import knn_mean_distances
from ddakf.kernels.preprocess import Grid, fill_grid


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

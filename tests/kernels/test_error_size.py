"""Sizes of errors: laws of evidence against NumPy, and distances along the cloth against shortest paths."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ddakf.garment import model
from ddakf.kernels import error_size as kernels
from ddakf.kernels.error_size import LogLaw
from tests.stages.scenes import tube

RNG = np.random.default_rng(3)
N = 40


def test_logarithms_of_the_laws_are_those_of_numpy():
    """Of no evidence and of much, of scales that both laws share and of others."""
    patch, seen = RNG.integers(0, 7, N).astype(np.int32), RNG.random(N) < 0.5
    by_patch, by_vertex = RNG.exponential(size=(3, 7)), RNG.exponential(size=(2, N)) * (RNG.random((2, N)) < 0.5)
    scale, power, base = RNG.uniform(0.1, 1, (5, 2)), RNG.uniform(0, 1, (5, 2)), RNG.normal(size=(2, 2))
    scale[::2, 1] = scale[::2, 0]
    got = np.empty((2, N))
    kernels.log_factors(by_patch, by_vertex, patch, seen, LogLaw(scale, power, base), got)
    values = np.vstack([by_patch[:, patch], by_vertex])
    terms = power.T[:, :, None] * np.log(1.0 + values / scale.T[:, :, None])
    np.testing.assert_allclose(got, base[:, seen.astype(int)] + terms.sum(axis=1), rtol=1e-12, atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1), most=st.sampled_from([0.02, 0.05, 10.0]))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_distances_along_the_cloth_are_those_of_shortest_paths(seed, most):
    rng = np.random.default_rng(seed)
    garment = model.build(tube(around=10, along=6))
    n = garment.mesh.n_vertices
    seen = rng.random(n) < rng.choice([0.0, 0.02, 0.5])
    distance = np.empty(n)
    kernels.distance_along_cloth(seen, garment.start, garment.neighbour, garment.rest_length, most, distance)
    row = np.repeat(np.arange(n), np.diff(garment.start.astype(int)))
    graph = csr_array((garment.rest_length.astype(float), (row, garment.neighbour.astype(int))), (n, n))
    expected = dijkstra(graph, indices=np.flatnonzero(seen), min_only=True) if seen.any() else np.full(n, np.inf)
    np.testing.assert_allclose(distance, np.minimum(expected, most), rtol=1e-5, atol=1e-7)

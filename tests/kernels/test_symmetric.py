"""Symmetric 3x3 matrices against NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from ddakf.kernels import symmetric


@njit
def eigen(M):
    return symmetric.smallest_eigenvector(M[0, 0], M[1, 1], M[2, 2], M[0, 1], M[0, 2], M[1, 2])


@njit
def inverse(M):
    return symmetric.invert3(M[0, 0], M[1, 1], M[2, 2], M[0, 1], M[0, 2], M[1, 2])


@njit
def along(M, n):
    return symmetric.along(M, n[0], n[1], n[2])


def matrix(values, seed):
    Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    M = Q * np.array(values) @ Q.T
    return 0.5 * (M + M.T)


SEEDS = st.integers(0, 2**32 - 1)
VALUE = st.floats(0.0, 1.0)


@given(values=st.tuples(VALUE, VALUE, VALUE), scale=st.sampled_from([1e-6, 1.0, 1e6]), seed=SEEDS)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_smallest_eigenvector(values, scale, seed):
    """Values to nine digits of the largest, where two fall together to half as many, and the residual of the vector."""
    M = scale * matrix(values, seed)
    expected, size = np.linalg.eigvalsh(M), scale * max(*values, 1e-12)
    smallest, middle, *vector = eigen(M)
    assert smallest == pytest.approx(expected[0], abs=1e-6 * size)
    assert middle == pytest.approx(expected[1], abs=1e-6 * size)
    assert np.linalg.norm(vector) == pytest.approx(1.0, abs=1e-9)
    if expected[1] - expected[0] > 1e-3 * size:
        assert np.linalg.norm(M @ vector - expected[0] * np.array(vector)) < 1e-6 * size


def test_of_equal_eigenvalues_the_vector_is_the_last_axis():
    assert eigen(np.zeros((3, 3))) == (0.0, 0.0, 0.0, 0.0, 1.0)
    assert eigen(2.5 * np.eye(3))[2:] == (0.0, 0.0, 1.0)


@given(values=st.tuples(*[st.floats(0.1, 10.0)] * 3), seed=SEEDS)
@settings(max_examples=50, deadline=None, derandomize=True)
def test_inverse_and_quadratic_form(values, seed):
    M = matrix(values, seed)
    a, b, c, d, e, f = inverse(M)
    np.testing.assert_allclose(np.array([[a, d, e], [d, b, f], [e, f, c]]) @ M, np.eye(3), atol=1e-10)
    n = np.random.default_rng(seed).normal(size=3)
    assert along(M, n) == pytest.approx(n @ M @ n, rel=1e-12)

"""Sums by patch, the covariance of patches and of vertices against NumPy."""

import numpy as np
import pytest

from ddakf.kernels import uncertainty as kernels
from ddakf.kernels.uncertainty import MeasuredPlanes, PatchMeans, PatchSums
from tests.stages.dense import blockdiag


@pytest.mark.parametrize("measured", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("isotropic", [False, True])
def test_sums_and_means_of_patches_are_those_of_numpy(measured, isotropic):
    rng, n, count = np.random.default_rng(3), 40, 5
    position, last, prior, surface, normal = rng.normal(size=(5, n, 3))
    surface, normal = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (surface, normal))
    patch, strain, variance = rng.permutation(np.arange(n) % count).astype(np.int32), rng.random(n), rng.uniform(1, 2, n)
    weight = rng.uniform(0.1, 1, n) * (rng.random(n) < measured)
    sums = PatchSums(*(np.empty((count, *more)) for more in ((), (), (6,), (3,), (4,), (4,), (), ())))
    means = PatchMeans(*(np.empty((count, *more)) for more in ((6,), (), (), (), (), ())))
    planes = MeasuredPlanes(weight, normal, variance, isotropic)
    kernels.sum_by_patch(position, last, prior, surface, patch, strain, planes, sums)
    kernels.patch_means(sums, 4.0, 0.02, means)
    member, used = np.eye(count)[patch].T, weight > 0
    seen = (member * used).sum(axis=1)
    matrices = np.eye(3) if isotropic else normal[:, :, None] * normal[:, None, :]
    information = np.einsum("kv,vab->kab", member, (weight / variance)[:, None, None] * matrices)
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    per = np.maximum(seen, 1.0)
    np.testing.assert_allclose(means.information, information[:, rows, columns] / (4.0 * per)[:, None], atol=1e-12)
    facing = (member * used) @ normal / per[:, None]
    np.testing.assert_allclose(means.bend, np.maximum(1.0 - np.square(facing).sum(axis=1), 0.02), atol=1e-12)
    np.testing.assert_allclose(means.strain2, member @ strain / member.sum(axis=1))
    sine2 = (1.0 - np.einsum("va,va->v", surface, normal) ** 2) * (used & (not isotropic))
    expected = np.where(seen > 0, member @ sine2 / per, sine2.sum() / max(seen.sum(), 1.0))
    np.testing.assert_allclose(means.turned, expected, atol=1e-12)
    for got, step, chosen in ((means.motion2, position - last, np.ones(n)), (means.innovation2, position - prior, used)):
        about = step - (chosen @ step) / max(chosen.sum(), 1.0)
        chosen_of = member * chosen
        np.testing.assert_allclose(
            got, chosen_of @ np.square(about).sum(axis=1) / np.maximum(chosen_of.sum(axis=1), 1.0), atol=1e-12
        )


@pytest.mark.parametrize("measured", [0.0, 0.4, 1.0])
def test_errors_grow_and_are_updated_as_matrices_are(measured):
    rng, count = np.random.default_rng(4), 7
    n = 3 * count
    roots = rng.normal(size=(2, n, n))
    P, C = 1e-4 * roots[0] @ roots[0].T, 10.0 * roots[1] @ roots[1].T + 1e3 * np.eye(n)
    normal = rng.normal(size=(count, 3, 3)) * 60.0 * (rng.random(count) < measured)[:, None, None]
    blocks = normal @ normal.transpose(0, 2, 1)
    information = blocks[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    G = np.linalg.inv(C + blockdiag(information))
    F, got = np.eye(n) - G @ blockdiag(information), np.empty((n, n), np.float32)
    assert kernels.update_errors(P.astype(np.float32), G.astype(np.float32), information, got)
    expected = F @ P @ F.T + G @ blockdiag(information) @ G
    assert np.abs(got - expected).max() < 1e-4 * np.abs(expected).max()
    np.testing.assert_array_equal(got, got.T)
    assert not kernels.update_errors(P.astype(np.float32), np.full((n, n), np.nan, np.float32), information, got)
    similar, growth2 = np.exp(-rng.random((count, count))).astype(np.float32), rng.uniform(0, 1e-3, count)
    for ceiling in (10.0, 0.01):
        kernels.grow(P.astype(np.float32), 0.7, similar, growth2, ceiling, got)
        expected = 0.7 * P + np.kron(np.sqrt(growth2)[:, None] * similar * np.sqrt(growth2), np.eye(3))
        expected *= min(1.0, ceiling**2 / expected.diagonal().max())
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("isotropic", [False, True])
def test_covariances_of_vertices_are_those_of_their_patches_given_the_measurement(isotropic):
    rng, n, count = np.random.default_rng(5), 30, 4
    root = rng.normal(scale=0.01, size=(3 * count, 3 * count))
    drift, added, bend = (root @ root.T).astype(np.float32), rng.uniform(0, 1e-4, count), rng.uniform(0, 1, count)
    patch, normal = rng.integers(0, count, n).astype(np.int32), rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    weight, variance, got = rng.uniform(0, 1, n) * (rng.random(n) < 0.7), rng.uniform(1e-6, 1e-4, n), np.empty((n, 3, 3))
    planes = MeasuredPlanes(weight, normal, variance, isotropic)
    kernels.vertex_covariances(drift, 1.3, added, bend, patch, planes, got)
    for i in range(n):
        at = slice(3 * patch[i], 3 * patch[i] + 3)
        expected = 1.3 * drift[at, at].astype(float) + added[patch[i]] * np.eye(3)
        if weight[i] > 0 and isotropic:
            expected = np.linalg.inv(np.linalg.inv(expected) + weight[i] / variance[i] * np.eye(3))
        elif weight[i] > 0:
            g = expected @ normal[i]
            along = normal[i] @ g
            known = along + variance[i] / weight[i] + bend[patch[i]] * (np.trace(expected) - along)
            expected = expected - np.outer(g, g) / known
        np.testing.assert_allclose(got[i], expected, rtol=1e-6, atol=1e-12)
    traces = np.trace(got, axis1=1, axis2=2)
    mean, largest = kernels.mean_and_largest_trace(got)
    assert (mean, largest) == (pytest.approx(traces.mean()), pytest.approx(traces.max()))
    got[3, 1, 1] = np.nan
    assert not np.isfinite(kernels.mean_and_largest_trace(got)).any()

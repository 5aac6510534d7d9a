"""Sizes of the error along the normal and across it."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Tracker
from ddakf.kernels.error_size import LEAST, LogLaw
from ddakf.stages import error_size
from ddakf.stages.error_size import SizeEvidence, Sizes
from tests.tracker_runs import FPS, SHIRT, TUBE, cloud, scan

RNG = np.random.default_rng(3)
N = 40
NOTHING = SizeEvidence(*np.zeros((len(SizeEvidence._fields), N)))


def covariances(n=N):
    root = RNG.normal(scale=0.01, size=(n, 3, 3))
    return root @ root.transpose(0, 2, 1) + 1e-8 * np.eye(3)


def normals(n=N):
    normal = RNG.normal(size=(n, 3))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def resized(covariance, normal, along, across, powers):
    return error_size.resized(covariance, normal, Sizes(np.log([along, across]), powers))


def resized_by_matrices(covariance, normal, sizes, powers):
    """M C M with M = a n n' + b (I - n n'): the same in NumPy."""
    n = normal[:, :, None] * normal[:, None, :]
    v = np.maximum(np.einsum("va,vab,vb->v", normal, covariance, normal), LEAST)
    t = np.maximum(0.5 * (np.einsum("vaa->v", covariance) - v), LEAST)
    a, b = (
        size * (np.sqrt(u) / error_size.USUAL) ** power / np.sqrt(u) for size, u, power in zip(sizes, (v, t), powers, strict=True)
    )
    M = a[:, None, None] * n + b[:, None, None] * (np.eye(3) - n)
    return M @ covariance @ M


@pytest.mark.parametrize("scale", [1.0, 0.0], ids=["random", "nothing claimed"])
def test_resizing_is_a_congruence_by_matrices(scale):
    covariance, normal, sizes = scale * covariances(), normals(), RNG.uniform(0.001, 0.1, (2, N))
    expected = resized_by_matrices(covariance, normal, sizes, (0.4, 0.3))
    np.testing.assert_allclose(resized(covariance, normal, *sizes, (0.4, 0.3)), expected, rtol=1e-9, atol=1e-15)


def test_with_powers_of_zero_the_sizes_are_those_of_the_laws():
    covariance, normal, along, across = covariances(), normals(), RNG.uniform(0.001, 0.1, N), RNG.uniform(0.001, 0.1, N)
    out = resized(covariance, normal, along, across, (0.0, 0.0))
    v = np.einsum("va,vab,vb->v", normal, out, normal)
    np.testing.assert_allclose(v, along**2, rtol=1e-9)
    np.testing.assert_allclose(0.5 * (np.einsum("vaa->v", out) - v), across**2, rtol=1e-9)


def test_with_powers_of_one_and_usual_factors_nothing_changes():
    covariance, usual = covariances(), np.full(N, error_size.USUAL)
    np.testing.assert_allclose(resized(covariance, normals(), usual, usual, (1.0, 1.0)), covariance, rtol=1e-9, atol=1e-15)


def test_a_resized_covariance_is_one_and_keeps_its_shape_in_the_tangent_plane():
    covariance, normal = covariances(), normals()
    out = resized(covariance, normal, RNG.uniform(1e-4, 1, N), RNG.uniform(1e-4, 1, N), (0.7, 0.4))
    np.testing.assert_allclose(out, out.transpose(0, 2, 1), rtol=1e-9, atol=1e-18)
    assert (np.linalg.eigvalsh(out) > 0).all()
    across = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    before, after = across @ covariance @ across, across @ out @ across
    ratio = np.einsum("vaa->v", after) / np.einsum("vaa->v", before)
    np.testing.assert_allclose(after, ratio[:, None, None] * before, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("name", SizeEvidence._fields)
@pytest.mark.parametrize("law", [Config().normal_error, Config().tangential_error], ids=["normal", "tangential"])
def test_evidence_makes_errors_larger_and_never_smaller(name, law):
    worse = NOTHING._replace(**{name: 10 * getattr(law, f"{name}_scale") + 0 * getattr(NOTHING, name)})
    both = (np.array([values(law)] * 2).T for values in (error_size._SCALES, error_size._POWERS))
    laws, patch, seen = LogLaw(*both, np.zeros((2, 2))), np.arange(N), np.zeros(N, bool)
    factor, none = (np.exp(error_size._log_factors(found, laws, patch, seen)[0]) for found in (worse, NOTHING))
    np.testing.assert_array_equal(none, 1.0)
    assert (factor > 1.0).all() == (getattr(law, f"{name}_power") > 0.0)
    np.testing.assert_allclose(factor, 11.0 ** getattr(law, f"{name}_power"))


def sigma(mesh, points, config=None, frames=6):
    tracker = Tracker(mesh, **({} if config is None else {"config": config}))
    return [tracker.step(points(k), timestamp=k / FPS) for k in range(frames)][-1]


def test_a_garment_that_can_turn_unnoticed_is_less_certain_across_its_normals():
    """Than the same with a law that does not know of it."""
    blind = dataclasses.replace(Config().tangential_error, slip_power=0.0)
    known = dataclasses.replace(Config(), uncertainty=dataclasses.replace(Config().uncertainty, turn_rate=0.0))
    configs = known, dataclasses.replace(known, tangential_error=blind)
    tube = [sigma(TUBE, lambda k: scan(TUBE.vertices, TUBE, seed=k), c).sigma.mean() for c in configs]
    shirt = [sigma(SHIRT, lambda k: scan(SHIRT.vertices, SHIRT, seed=k), c).sigma.mean() for c in configs]
    assert tube[0] / tube[1] > 1.1 * shirt[0] / shirt[1]


def test_what_is_known_of_hems_stays_while_nothing_is_seen():
    tracker = Tracker(TUBE)
    for k in range(5):
        seen = tracker.step(cloud(k), timestamp=k / FPS)
    known = tracker._track.drift.hem2
    empty = tracker.step(cloud(0)[:0], timestamp=5 / FPS)
    assert tracker._track.drift.hem2 == known
    assert empty.sigma.mean() > seen.sigma.mean()

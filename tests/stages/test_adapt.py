"""Stage D by the formulas of section 2.3 and the clamp of section 2.7."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf.config import Config, InnovationNoise, ResidualNoise
from ddakf.stages import adapt as stage
from tests.stages.scenes import estimate_at, measured, problem_of, random_state

SEEDS = st.integers(0, 2**32 - 1)
PAPER = InnovationNoise(lowest_sd=1e-5, highest_sd=10.0)
RESIDUAL = ResidualNoise(lowest_sd=1e-5, highest_sd=10.0)


def adapt(last, measurement, weight, prior, position, config):
    """Stage D of a frame with this last posterior and prediction, at an estimate."""
    whole = dataclasses.replace(Config.paper() if isinstance(config, InnovationNoise) else Config(), adapt=config)
    return stage.adapt(problem_of(None, prior, whole, state=last), estimate_at(position), measurement, weight)


def scene(seed, n=40, scale=0.01, planes=False):
    """Last state, measurement, weight, prior and estimate."""
    rng = np.random.default_rng(seed)
    last = random_state(rng.normal(size=(n, 3)), rng, sd=0.002)
    prior = last._replace(position=last.position + rng.normal(scale=0.005, size=(n, 3)))
    estimate = prior.position + rng.normal(scale=0.005, size=(n, 3))
    normal = None
    if planes:
        normal = rng.normal(size=(n, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    target = prior.position + rng.normal(scale=scale, size=(n, 3))
    found = rng.random(n) < 0.8
    weight = np.where(found & (rng.random(n) < 0.8), rng.uniform(0.1, 1, n), 0.0)
    return last, measured(target, normal, found), weight, prior, estimate


def along(normal, R):
    return np.einsum("va,vab,vb->v", normal, R, normal)


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None, derandomize=True)
def test_innovations_are_smoothed_by_the_papers_formula(seed):
    last, measurement, weight, prior, estimate = scene(seed)
    R = adapt(last, measurement, weight, prior, estimate, PAPER)
    for i in np.flatnonzero(weight > 0):
        y = measurement.target[i] - prior.position[i]
        expected = PAPER.alpha * last.R[i] + (1 - PAPER.alpha) * (np.outer(y, y) + PAPER.epsilon * np.eye(3))
        np.testing.assert_allclose(R[i], expected, rtol=1e-9, atol=1e-14)


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None, derandomize=True)
def test_residuals_are_smoothed_along_the_normal(seed):
    last, measurement, weight, prior, estimate = scene(seed, planes=True)
    R = adapt(last, measurement, weight, prior, estimate, RESIDUAL)
    n, used = measurement.normal, weight > 0
    e = np.einsum("va,va->v", n, measurement.target - estimate)
    sample = e**2 + np.minimum(along(n, last.P_pp), along(n, last.R)) + RESIDUAL.epsilon
    expected = RESIDUAL.alpha * along(n, last.R) + (1 - RESIDUAL.alpha) * sample
    np.testing.assert_allclose(along(n, R)[used], expected[used], rtol=1e-9)


@pytest.mark.parametrize(
    ("config", "planes"),
    [(Config().adapt, True), (Config.paper().adapt, False), (Config.paper().adapt, True)],
    ids=["residual", "innovation of points", "innovation of planes"],
)
@given(seed=SEEDS, scale=st.sampled_from([0.0, 1e-6, 0.01, 1.0, 100.0]))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_variances_stay_between_the_bounds(config, planes, seed, scale):
    last, measurement, weight, prior, estimate = scene(seed, scale=scale, planes=planes)
    for _ in range(3):
        R = adapt(last, measurement, weight, prior, estimate, config)
        last = last._replace(R=R)
    used = weight > 0
    low, high = config.lowest_sd**2, config.highest_sd**2
    np.testing.assert_allclose(R, R.transpose(0, 2, 1), atol=1e-15)
    assert np.linalg.eigvalsh(R).min() > 0
    measured = along(measurement.normal, R)[used] if planes else np.linalg.eigvalsh(R[used])
    assert measured.min() >= low * (1 - 1e-6)
    assert measured.max() <= high * (1 + 1e-6)


def test_what_grew_out_of_sight_is_no_noise():
    last, measurement, weight, prior, _ = scene(5, planes=True)
    used = weight > 0
    wide = last._replace(P_pp=np.tile(np.eye(3), (len(used), 1, 1)))
    R = adapt(wide, measurement, weight, prior, measurement.target, RESIDUAL)
    before = along(measurement.normal, wide.R)[used]
    assert (along(measurement.normal, R)[used] <= before + (1 - RESIDUAL.alpha) * RESIDUAL.epsilon * (1 + 1e-9)).all()


@pytest.mark.parametrize("config", [Config().adapt, Config.paper().adapt], ids=["residual", "innovation"])
def test_unused_vertices_keep_theirs_to_the_bit(config):
    last, measurement, weight, prior, estimate = scene(2, planes=True)
    before = last.R.copy()
    R = adapt(last, measurement, weight, prior, estimate, config)
    np.testing.assert_array_equal(R[weight == 0], before[weight == 0])
    np.testing.assert_array_equal(last.R, before)
    assert not np.array_equal(R[weight > 0], before[weight > 0])


@pytest.mark.parametrize("spread", [0.003, 0.006])
@pytest.mark.parametrize("start", [0.002, 0.02])
def test_learns_the_sensors_noise_whatever_the_prediction_errs(start, spread):
    """A plane seen by a Kalman filter: residual and posterior as theory has them, R at first far off."""
    rng = np.random.default_rng(3)
    n, noise = 300, 0.006
    normal = np.tile([0.0, 0.6, 0.8], (n, 1))
    config = dataclasses.replace(Config().adapt, lowest_sd=0.001, highest_sd=0.1, alpha=0.95)
    state, everyone = random_state(np.zeros((n, 3)), rng), np.ones(n, bool)
    state = state._replace(R=np.tile(start**2 * np.eye(3), (n, 1, 1)))
    for _ in range(400):
        variance = along(normal, state.R)
        gain = spread**2 / (spread**2 + variance)
        truth = rng.normal(scale=spread, size=n)  # the prediction is zero
        z = truth + rng.normal(scale=noise, size=n)
        posterior = ((1 - gain) * spread**2)[:, None, None] * np.eye(3)
        state = state._replace(P_pp=posterior)
        measurement = measured(z[:, None] * normal, normal, everyone)
        prior = state._replace(position=np.zeros((n, 3)))
        R = adapt(state, measurement, np.ones(n), prior, (gain * z)[:, None] * normal, config)
        state = state._replace(R=R)
    assert np.sqrt(along(normal, state.R).mean()) == pytest.approx(noise, rel=0.1)


def test_the_papers_formula_learns_the_innovation():
    rng = np.random.default_rng(4)
    n, noise, spread = 400, 0.006, 0.012
    state, everyone = random_state(np.zeros((n, 3)), rng), np.ones(n, bool)
    for _ in range(100):
        target = rng.normal(scale=np.hypot(noise, spread), size=(n, 3))
        measurement = measured(target, None, everyone)
        state = state._replace(R=adapt(state, measurement, np.ones(n), state, state.position, InnovationNoise()))
    sd = np.sqrt(np.trace(state.R, axis1=1, axis2=2).mean() / 3)
    assert sd == pytest.approx(np.hypot(noise, spread), rel=0.1)

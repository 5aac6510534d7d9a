"""Stage C by the formulas of section 2.5."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from ddakf.config import Config, NoWeight, Tukey
from ddakf.stages import robust
from ddakf.stages.robust import gate_threshold, tukey
from ddakf.types import State
from tests.stages.scenes import blocks, estimate_at, measured, problem_of

CONFIG = Tukey()


def weigh(measurement, position, prior_covariance, R, config):
    """Stage C of a frame with these covariances, at an estimate."""
    start = State.at(np.zeros_like(position), np.zeros_like(position), 1.0, 1.0, 1.0)
    problem = problem_of(None, start._replace(P_pp=prior_covariance), dataclasses.replace(Config(), robust=config))
    return robust.weigh(problem._replace(state=start._replace(R=R)), estimate_at(position), measurement)


def points(y, found=None):
    n = len(y)
    found = np.ones(n, bool) if found is None else found
    return measured(y, None, found)


def planes(distance, found=None, seed=0):
    """Planes at signed ``distance`` (V,) from the origin, and their normals."""
    n = len(distance)
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    across = np.cross(normal, rng.normal(size=(n, 3)))  # where in the plane the target lies must not matter
    found = np.ones(n, bool) if found is None else found
    return measured(np.asarray(distance)[:, None] * normal + 0.05 * across, normal, found), normal


@given(ratio=st.floats(0, 50), cutoff=st.floats(0.5, 10))
def test_tukey_is_the_bisquare(ratio, cutoff):
    expected = (1 - (ratio / cutoff) ** 2) ** 2 if ratio < cutoff else 0.0
    assert tukey(np.array([ratio]), cutoff)[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("dimension", [1, 3])
@pytest.mark.parametrize("probability", [0.5, 0.9, 0.999, 1 - 1e-12, 1.0])
def test_gate_is_the_chi_square_quantile(dimension, probability):
    assert gate_threshold(probability, dimension) == pytest.approx(chi2.isf(1 - probability, dimension), rel=1e-14)


def test_point_weights_follow_the_mahalanobis_distance():
    rng = np.random.default_rng(0)
    n = 200
    P, R = blocks(n, 3, rng) * 1e-4, blocks(n, 3, rng) * 2e-5
    y = rng.normal(scale=0.02, size=(n, 3))
    expected = []
    for i in range(n):
        d2 = y[i] @ np.linalg.inv(P[i] + R[i]) @ y[i]
        inside = d2 <= chi2.ppf(CONFIG.gate_probability, 3) and d2 < CONFIG.cutoff**2
        expected.append((1 - d2 / CONFIG.cutoff**2) ** 2 if inside else 0.0)
    weight = weigh(points(y), np.zeros((n, 3)), P, R, CONFIG)
    np.testing.assert_allclose(weight, expected, atol=1e-12)
    assert 0 < np.count_nonzero(weight) < n  # both sides of the gate occur


def test_plane_weights_follow_the_distance_along_the_normal():
    """With residuals below the sensor's noise the scale is that noise."""
    rng = np.random.default_rng(1)
    distance = rng.normal(scale=0.001, size=300)
    distance[:8] = np.linspace(0.008, 0.02, 8)
    measurement, _ = planes(distance)
    R = np.tile(0.004**2 * np.eye(3), (300, 1, 1))
    ratio = np.abs(distance) / 0.004
    inside = ratio**2 <= chi2.ppf(CONFIG.gate_probability, 1)
    expected = np.where(inside & (ratio < CONFIG.cutoff), (1 - (ratio / CONFIG.cutoff) ** 2) ** 2, 0.0)
    np.testing.assert_allclose(weigh(measurement, np.zeros((300, 3)), 1e-4 * R, R, CONFIG), expected, atol=1e-9)
    assert (expected == 0).any()


@pytest.mark.parametrize("kind", ["points", "planes"])
@given(share=st.floats(0.01, 0.3), size=st.floats(0.5, 50), seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_a_gross_outlier_has_weight_zero(kind, share, size, seed):
    rng = np.random.default_rng(seed)
    n = 100
    bad = np.arange(n) < max(1, int(share * n))
    distance = np.where(bad, size, rng.normal(scale=0.003, size=n))
    measurement = planes(distance)[0] if kind == "planes" else points(distance[:, None] * [1.0, 0.0, 0.0])
    R = np.tile(0.004**2 * np.eye(3), (n, 1, 1))
    weight = weigh(measurement, np.zeros((n, 3)), R, R, CONFIG)
    assert (weight[bad] == 0).all()
    assert (weight[~bad] > 0).mean() > 0.9


def test_a_common_shift_between_passes_is_not_gated_away():
    measurement, _ = planes(np.random.default_rng(2).normal(0.03, 0.003, size=200))
    R = np.tile(0.004**2 * np.eye(3), (200, 1, 1))
    assert (weigh(measurement, np.zeros((200, 3)), R, R, CONFIG) > 0).mean() > 0.95


@pytest.mark.parametrize("config", [CONFIG, NoWeight()], ids=["tukey", "no weight"])
@pytest.mark.parametrize("kind", ["points", "planes"])
def test_what_was_not_found_has_no_weight(config, kind):
    found = np.arange(50) % 3 > 0
    measurement = planes(np.zeros(50), found)[0] if kind == "planes" else points(np.zeros((50, 3)), found)
    R = np.tile(1e-5 * np.eye(3), (50, 1, 1))
    weight = weigh(measurement, np.zeros((50, 3)), R, R, config)
    np.testing.assert_array_equal(weight > 0, found)
    assert ((weight >= 0) & (weight <= 1)).all()
    nothing = measured(measurement.target, measurement.normal, np.zeros(50, bool))
    assert not weigh(nothing, np.zeros((50, 3)), R, R, config).any()


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_a_larger_residual_never_weighs_more(seed):
    rng = np.random.default_rng(seed)
    distance = np.sort(rng.exponential(0.005, size=60))
    R = np.tile(0.004**2 * np.eye(3), (60, 1, 1))
    assert (np.diff(weigh(planes(distance)[0], np.zeros((60, 3)), R, R, CONFIG)) <= 1e-12).all()
    assert (np.diff(weigh(points(distance[:, None] * [0, 1.0, 0]), np.zeros((60, 3)), R, R, CONFIG)) <= 1e-12).all()

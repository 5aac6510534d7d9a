"""Calibration metrics against values by hand, and against calibrated samples."""

import numpy as np
import pytest

from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)


def test_mahalanobis_of_a_diagonal_covariance():
    covariance = np.tile(np.diag([1e-4, 4e-4, 9e-4]), (4, 1, 1))
    m = metrics.squared_mahalanobis(SQUARE + np.array([0.01, 0.02, 0.03]), SQUARE, covariance)
    assert np.allclose(m, 3)
    assert metrics.nees3(m) == pytest.approx(1)
    assert metrics.coverage90(m) == 1
    assert metrics.coverage90(m * [1, 2, 2.1, 3]) == 0.5
    assert np.isnan(metrics.coverage90(m[:0]))
    assert np.isnan(metrics.nees3(m[:0]))


def test_a_gaussian_with_the_claimed_covariance_is_calibrated():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    error = rng.normal(size=(40_000, 3)) @ root.T
    m = metrics.squared_mahalanobis(error, 0 * error, np.tile(root @ root.T, (len(error), 1, 1)))
    assert metrics.coverage90(m) == pytest.approx(0.9, abs=0.01)
    assert metrics.nees3(m) == pytest.approx(1, abs=0.02)


def test_nominal_probability_is_the_chi_square_distribution_function():
    assert metrics.nominal_probability(np.array([0, metrics.CHI2_3_90, np.inf])) == pytest.approx([0, 0.9, 1], abs=1e-5)


def test_gaussian_nll_by_hand():
    covariance = np.tile(np.diag([1.0, 4.0, 9.0]), (2, 1, 1))
    nll = metrics.gaussian_nll(np.array([0.0, 3.0]), covariance)
    at_the_mean = 0.5 * np.log((2 * np.pi) ** 3 * 36)  # the density there is 1 / sqrt((2 pi)^3 det P)
    assert nll == pytest.approx([at_the_mean, at_the_mean + 1.5])
    with pytest.raises(InvalidArgument, match="positive definite"):
        metrics.gaussian_nll(np.zeros(1), np.diag([1.0, 1.0, -1.0])[None])


def test_no_constant_covariance_beats_the_second_moment():
    rng = np.random.default_rng(0)
    error = rng.normal(size=(200, 3)) @ rng.normal(size=(3, 3))
    best = metrics.second_moment(error, 0 * error)

    def mean_nll(covariance):
        claimed = np.tile(covariance, (len(error), 1, 1))
        return metrics.gaussian_nll(metrics.squared_mahalanobis(error, 0 * error, claimed), claimed).mean()

    assert metrics.best_constant_nll(best) == pytest.approx(mean_nll(best))
    for other in (0.8 * best, 1.2 * best, best + 0.1 * np.diag(np.diag(best)) * [1, 0, -1]):
        assert mean_nll(other) > metrics.best_constant_nll(best)


def test_there_must_be_a_covariance_per_vertex():
    with pytest.raises(InvalidArgument, match="covariance"):
        metrics.squared_mahalanobis(SQUARE, SQUARE, np.eye(3))

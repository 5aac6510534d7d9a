"""Calibration: claimed covariances against the actual errors."""

from __future__ import annotations

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.evaluation.metrics.vertex_error import difference

NOMINAL_PROBABILITIES = tuple(round(0.05 * k, 2) for k in range(1, 20)) + (0.99,)  # probabilities of the reliability diagram
CHI2_3_90 = 6.2514  # 0.9 quantile of the chi-square distribution with 3 degrees of freedom
LOG_2PI = float(np.log(2 * np.pi))  # of the normalisation of a Gaussian


def squared_mahalanobis(estimate: np.ndarray, truth: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(V,) (E_i - T_i)' P_i^-1 (E_i - T_i) with the claimed position covariances P (V, 3, 3), m^2; no unit."""
    error = difference(estimate, truth)
    if covariance.shape != (len(error), 3, 3):
        raise InvalidArgument("covariance", f"shape ({len(error)}, 3, 3)", str(covariance.shape))
    return np.einsum("vi,vi->v", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])


def coverage90(mahalanobis: np.ndarray) -> float:
    """Share of vertices whose truth lies inside the 90 % ellipsoid: mean(m_i < 6.2514); 0.9 when calibrated.

    Args:
        mahalanobis: from :func:`squared_mahalanobis`, pooled over as many frames as there are.

    Returns:
        NaN without any.
    """
    return float(np.mean(mahalanobis < CHI2_3_90)) if len(mahalanobis) else float("nan")


def nees3(mahalanobis: np.ndarray) -> float:
    """Normalised estimation error squared per dimension: mean(m_i) / 3; 1 when calibrated, above when overconfident."""
    return float(np.mean(mahalanobis) / 3) if len(mahalanobis) else float("nan")


def nominal_probability(mahalanobis: np.ndarray) -> np.ndarray:
    """Probability content of the smallest claimed ellipsoid that holds the truth: the chi-square distribution function with
    3 degrees of freedom at m_i; uniform in [0, 1] when calibrated."""
    from scipy.special import gammainc

    return gammainc(1.5, 0.5 * np.asarray(mahalanobis))


def gaussian_nll(mahalanobis: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(V,) negative log-likelihood of the errors under the claimed Gaussians, (m_i + log det P_i + 3 log 2 pi) / 2; nats of
    a density in metres, so that only differences mean something.

    Args:
        mahalanobis: (V,) from :func:`squared_mahalanobis`.
        covariance: (V, 3, 3) square metres.

    Raises:
        InvalidArgument: a covariance that is not positive definite.
    """
    sign, log_det = np.linalg.slogdet(covariance)
    if not (sign > 0).all():
        raise InvalidArgument("covariance", "positive definite matrices", f"{int((sign <= 0).sum())} that are not")
    return 0.5 * (mahalanobis + log_det + 3 * LOG_2PI)


def best_constant_nll(second_moment: np.ndarray) -> float:
    """Mean negative log-likelihood of errors e under the one covariance that suits them best, which is C = mean(e e'):
    (3 + log det C + 3 log 2 pi) / 2; nats.

    A claimed covariance that varies from vertex to vertex must beat it, or it says no more than "about so much".

    Args:
        second_moment: (3, 3) C, square metres.

    Returns:
        Minus infinity where the errors do not span space, as fewer than three do not.
    """
    return 0.5 * (3 + float(np.linalg.slogdet(second_moment)[1]) + 3 * LOG_2PI)

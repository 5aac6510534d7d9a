"""Stage D, adaptation (paper, sections 2.3 and 2.7): the measurement covariance of each vertex follows its innovations."""

from __future__ import annotations

import numpy as np

from ddakf.associate import Measurement
from ddakf.config import AdaptiveNoise
from ddakf.types import State


def adapt(
    R: np.ndarray, measurement: Measurement, weight: np.ndarray, prior: State, config: AdaptiveNoise
) -> np.ndarray:
    """R = alpha R + (1 - alpha)(y y' + epsilon I), clamped to [R_min, R_max]; vertices without a measurement keep theirs.

    Args:
        R: (V, 3, 3) square metres, of the last frame.
        measurement, weight: of this pass; y is the innovation against the prediction.
        prior: the prediction.
        config: alpha, epsilon, the clamp, and whether the expected part H P H' is taken out of y y'.
    """
    used = weight > 0
    y = measurement.innovation(prior.position)[used]
    sample = y[:, :, None] * y[:, None, :]
    if config.subtract_expected:
        sample = sample - prior.P_pp[used]
    adapted = R.copy()
    adapted[used] = clamp(
        config.alpha * R[used] + (1.0 - config.alpha) * (sample + config.epsilon * np.eye(3)),
        config.lowest_sd**2,
        config.highest_sd**2,
    )
    return adapted


def clamp(matrices: np.ndarray, low: float, high: float) -> np.ndarray:
    """Symmetric (V, 3, 3) with their eigenvalues moved into [low, high]."""
    values, vectors = np.linalg.eigh(matrices)
    return np.einsum("vab,vb,vcb->vac", vectors, np.clip(values, low, high), vectors)

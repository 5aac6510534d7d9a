"""Stage D, adaptation (paper, sections 2.3 and 2.7): the measurement covariance of each vertex follows its residuals."""

from __future__ import annotations

import numpy as np

from ddakf.config import InnovationNoise, ResidualNoise
from ddakf.kernels import adapt as kernels
from ddakf.types import Estimate, Measurement, Problem


def adapt(problem: Problem, estimate: Estimate, measurement: Measurement, weight: np.ndarray) -> np.ndarray:
    """(V, 3, 3) R of this frame, square metres; vertices without a measurement keep theirs.

    ``InnovationNoise``: R = alpha R + (1 - alpha)(y y' + epsilon I), y the innovation against the prediction, eigenvalues
    clamped to [R_min, R_max]. ``ResidualNoise``: the same recursion for the variance along the measured normal, with
    e^2 + min(n' P n, n' R n) in place of y y', e the residual at the estimate and P the last posterior, of which a measurement
    leaves at most R, however wide it grew out of sight; R is scaled along n to match.

    Args:
        problem: the frame, with the last posterior and the prediction.
        estimate: where the vertices are.
        measurement, weight: of this pass.
    """
    last, config = problem.state, problem.config.adapt
    used = weight > 0
    low, high = config.lowest_sd**2, config.highest_sd**2
    R = last.R.copy()
    match config:
        case ResidualNoise():
            recursion = kernels.Recursion(config.alpha, config.epsilon, low, high)
            target, normal = measurement.target, measurement.normal
            kernels.adapt_along_normals(estimate.position, target, normal, used, last.P_pp, recursion, R)
        case InnovationNoise():
            y = measurement.innovation(problem.prior.position)[used]
            sample = y[:, :, None] * y[:, None, :] + config.epsilon * np.eye(3)
            R[used] = clamp(config.alpha * R[used] + (1.0 - config.alpha) * sample, low, high)
    return R


def clamp(matrices: np.ndarray, low: float, high: float) -> np.ndarray:
    """Symmetric (V, 3, 3) with their eigenvalues moved into [low, high]."""
    values, vectors = np.linalg.eigh(matrices)
    return np.einsum("vab,vb,vcb->vac", vectors, np.clip(values, low, high), vectors)

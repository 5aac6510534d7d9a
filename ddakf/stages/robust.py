"""Stage C, robustness (paper, section 2.5): Tukey weights and Mahalanobis gating."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import chdtri

from ddakf.config import NoWeight
from ddakf.kernels import robust as kernels
from ddakf.types import Estimate, Measurement, Problem


@lru_cache(maxsize=16)
def gate_threshold(probability: float, dimension: int) -> float:
    """Chi-square quantile for a Mahalanobis gate."""
    return float(chdtri(dimension, 1.0 - probability))


def weigh(problem: Problem, estimate: Estimate, measurement: Measurement) -> np.ndarray:
    """(V,) weights in [0, 1], zero outside the gate.

    Planes are judged by their distance from the estimate, in units of the frame's own robust scale or the sensor's noise,
    whichever is larger: the passes inside a frame correct a common shift, which must not be gated away. Points are judged, as
    in the paper, by the Mahalanobis distance of the innovation from the prediction.

    Args:
        problem: the frame, with the prior covariance and the last R.
        estimate: where the vertices are; before the first pass the prediction.
        measurement: of all vertices.
    """
    position, R, config = estimate.position, problem.state.R, problem.config.robust
    found = measurement.found
    weight = np.zeros(len(found))
    if not found.any():
        return weight
    if isinstance(config, NoWeight):
        weight[found] = 1.0
        return weight
    if measurement.normal is None:
        y = measurement.innovation(position)[found]
        d2 = np.einsum("va,va->v", y, np.linalg.solve((problem.prior.P_pp + R)[found], y[..., None])[..., 0])
        gated = d2 > gate_threshold(config.gate_probability, 3)
        weight[found] = np.where(gated, 0.0, tukey(np.sqrt(d2), config.cutoff))
        return weight
    squared, variance = np.empty(len(found)), np.empty(len(found))
    kernels.along_normals(position, measurement.target, measurement.normal, R, squared, variance)
    least = kernels.scale(found, squared, variance)
    kernels.bisquare(found, squared, variance, least, config.cutoff, gate_threshold(config.gate_probability, 1), weight)
    return weight


def tukey(ratio: np.ndarray, cutoff: float) -> np.ndarray:
    """Bisquare weight (1 - (r / c)^2)^2 for |r| < c, else 0."""
    return np.square(np.maximum(1.0 - np.square(ratio / cutoff), 0.0))

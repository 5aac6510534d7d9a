"""Stage C, robustness (paper, section 2.5): Tukey weights and Mahalanobis gating."""

from __future__ import annotations

from functools import lru_cache
from math import erfc, exp, inf, pi, sqrt

import numpy as np

from ddakf.config import NoWeight
from ddakf.kernels import robust as kernels
from ddakf.kernels.surface_points import FoundFaces
from ddakf.types import Estimate, Measurement, Problem

_LARGEST_GATE = 2000.0  # squared Mahalanobis distance beyond which the probability is below the smallest number


@lru_cache(maxsize=16)
def gate_threshold(probability: float, dimension: int) -> float:
    """Chi-square quantile for a Mahalanobis gate in 1 or 3 dimensions; to the last digits, by bisection."""
    outside = 1.0 - probability
    if outside <= 0.0:
        return inf
    low, high = 0.0, _LARGEST_GATE
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if beyond(middle, dimension) > outside else (low, middle)
    return high


def beyond(squared: float, dimension: int) -> float:
    """Probability of a greater chi-square value with 1 or 3 degrees of freedom (Abramowitz and Stegun, 26.4.4)."""
    assert dimension in (1, 3)
    in_one = erfc(sqrt(0.5 * squared))
    return in_one if dimension == 1 else in_one + sqrt(2.0 * squared / pi) * exp(-0.5 * squared)


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


def weigh_points(problem: Problem, found: FoundFaces) -> tuple[np.ndarray, float]:
    """(P,) weights in [0, 1] of points on faces, by their heights in units of a robust scale; and that scale, metres.

    It is at least the sensor's least noise.
    """
    config, weight = problem.config.robust, found.agrees.astype(float)
    if isinstance(config, NoWeight) or not found.agrees.any():
        return weight, problem.config.adapt.lowest_sd
    return weight, kernels.weigh_heights(found.offset, found.agrees, problem.config.adapt.lowest_sd, config.cutoff, weight)


def tukey(ratio: np.ndarray, cutoff: float) -> np.ndarray:
    """Bisquare weight (1 - (r / c)^2)^2 for |r| < c, else 0."""
    return np.square(np.maximum(1.0 - np.square(ratio / cutoff), 0.0))

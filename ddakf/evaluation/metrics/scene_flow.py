"""Scene flow: displacement of points from one frame to another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.evaluation.metrics.vertex_error import MM

NEAR = 0.05  # m: an end point this near counts as right


class EndPointError(NamedTuple):
    """Error of an estimated flow of n points."""

    mean_mm: float
    within_5cm: float  # share of the points whose end point is less than NEAR off
    n: int


def end_point_error(flow: np.ndarray, truth: np.ndarray) -> EndPointError:
    """|f_i - g_i| of estimated flows f and true ones g: mean, and share below 5 cm.

    Args:
        flow: (N, 3) metres; NaN where a method gives none: such a point is not within 5 cm, and makes the mean NaN.
        truth: (N, 3) metres; points without truth are not finite, and do not count.

    Returns:
        NaN where no point has a truth.

    Raises:
        InvalidArgument: other shapes.
    """
    flow, truth = np.asarray(flow, np.float64), np.asarray(truth, np.float64)
    if flow.shape != truth.shape or flow.ndim != 2 or flow.shape[1] != 3:
        raise InvalidArgument("flow", f"shape {truth.shape} as the truth", str(flow.shape))
    known = np.isfinite(truth).all(axis=1)
    error = np.linalg.norm(flow[known] - truth[known], axis=1)
    if len(error) == 0:
        return EndPointError(float("nan"), float("nan"), 0)
    return EndPointError(float(MM * error.mean()), float((error < NEAR).mean()), len(error))

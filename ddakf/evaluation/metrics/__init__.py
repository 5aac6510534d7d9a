"""How good an estimate is. E estimate, T truth, V vertices; positions in metres, errors reported in millimetres.

One file per idea; ``docs/metrics.md`` lists every metric with its formula and unit.
"""

from ddakf.evaluation.metrics.body import Penetration
from ddakf.evaluation.metrics.calibration import (
    CHI2_3_90,
    best_constant_nll,
    coverage90,
    gaussian_nll,
    nees3,
    nominal_probability,
    squared_mahalanobis,
)
from ddakf.evaluation.metrics.error import MM, normal_rmse_mm, rmse_mm, second_moment
from ddakf.evaluation.metrics.ranks import roc_auc, spearman
from ddakf.evaluation.metrics.shape import ShapeDifference, crossings
from ddakf.evaluation.metrics.surface import SurfaceDistance
from ddakf.evaluation.metrics.temporal import flicker_mm, frames_until_within

__all__ = [
    "CHI2_3_90",
    "MM",
    "Penetration",
    "ShapeDifference",
    "SurfaceDistance",
    "best_constant_nll",
    "coverage90",
    "crossings",
    "flicker_mm",
    "frames_until_within",
    "gaussian_nll",
    "nees3",
    "nominal_probability",
    "normal_rmse_mm",
    "rmse_mm",
    "roc_auc",
    "second_moment",
    "spearman",
    "squared_mahalanobis",
]

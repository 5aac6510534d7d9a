"""Metrics of an estimate. E estimate, T truth, V vertices; positions in metres, errors in millimetres.

One module per idea; ``docs/metrics.md`` lists every metric with its formula and unit.
"""

from ddakf.evaluation.metrics.calibration import (
    CHI2_3_90,
    best_constant_nll,
    coverage90,
    gaussian_nll,
    nees3,
    nominal_probability,
    squared_mahalanobis,
)
from ddakf.evaluation.metrics.hausdorff import Hausdorff
from ddakf.evaluation.metrics.limbs import Limbs
from ddakf.evaluation.metrics.penetration import Depth, Penetration, violating_mm
from ddakf.evaluation.metrics.rank_correlation import roc_auc, spearman
from ddakf.evaluation.metrics.resident_memory import ResidentPeak
from ddakf.evaluation.metrics.scene_flow import EndPointError, end_point_error
from ddakf.evaluation.metrics.shape import ShapeDifference, crossings
from ddakf.evaluation.metrics.silhouette import Overlap, silhouette_cameras, silhouette_iou, silhouette_overlap
from ddakf.evaluation.metrics.surface_distance import Residual, SurfaceDistance
from ddakf.evaluation.metrics.temporal import acceleration_variance_mm2, flicker_mm, frames_until_within, own_flicker_mm
from ddakf.evaluation.metrics.vertex_error import MM, normal_rmse_mm, rmse_mm, second_moment, tangential_rmse_mm

__all__ = [
    "CHI2_3_90",
    "MM",
    "Depth",
    "EndPointError",
    "Hausdorff",
    "Limbs",
    "Overlap",
    "Penetration",
    "ResidentPeak",
    "Residual",
    "ShapeDifference",
    "SurfaceDistance",
    "acceleration_variance_mm2",
    "best_constant_nll",
    "coverage90",
    "crossings",
    "end_point_error",
    "flicker_mm",
    "frames_until_within",
    "gaussian_nll",
    "nees3",
    "nominal_probability",
    "normal_rmse_mm",
    "own_flicker_mm",
    "rmse_mm",
    "roc_auc",
    "second_moment",
    "silhouette_cameras",
    "silhouette_iou",
    "silhouette_overlap",
    "spearman",
    "squared_mahalanobis",
    "tangential_rmse_mm",
    "violating_mm",
]

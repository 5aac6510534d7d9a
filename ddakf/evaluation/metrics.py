"""How good an estimate is. E estimate, T truth, n vertices; positions in metres, errors reported in millimetres."""

from __future__ import annotations

import numpy as np
from scipy.stats import rankdata

from ddakf.errors import InvalidArgument
from ddakf.mesh import Mesh, vertex_normals
from ddakf.physics import proximity

CHI2_3_90 = 6.2514  # 0.9 quantile of the chi-square distribution with 3 degrees of freedom
MM = 1e3  # millimetres per metre


def rmse_mm(estimate: np.ndarray, truth: np.ndarray) -> float:
    """sqrt(mean_i |E_i - T_i|^2) over the vertices (V, 3); millimetres."""
    error = _difference(estimate, truth)
    return float(MM * np.sqrt((error**2).sum(axis=1).mean()))


def normal_rmse_mm(estimate: np.ndarray, truth: np.ndarray, faces: np.ndarray) -> float:
    """sqrt(mean_i ((E_i - T_i) . n_i)^2) with the truth's area-weighted unit normals n_i; millimetres.

    The part of the error that changes the shape; the rest slides within the surface.
    """
    along = (_difference(estimate, truth) * vertex_normals(np.asarray(truth, np.float64), faces)).sum(axis=1)
    return float(MM * np.sqrt((along**2).mean()))


def squared_mahalanobis(estimate: np.ndarray, truth: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(V,) (E_i - T_i)' P_i^-1 (E_i - T_i) with the claimed position covariances P (V, 3, 3), m^2; no unit."""
    error = _difference(estimate, truth)
    if covariance.shape != (len(error), 3, 3):
        raise InvalidArgument("covariance", f"shape ({len(error)}, 3, 3)", str(covariance.shape))
    return np.einsum("vi,vi->v", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])


def coverage90(mahalanobis: np.ndarray) -> float:
    """Share of vertices whose truth lies inside the 90 % ellipsoid: mean(m_i < 6.2514); 0.9 when calibrated.

    Args:
        mahalanobis: from :func:`squared_mahalanobis`, pooled over as many frames as there are.

    Returns:
        NaN when there is none.
    """
    return float(np.mean(mahalanobis < CHI2_3_90)) if len(mahalanobis) else float("nan")


def nees3(mahalanobis: np.ndarray) -> float:
    """Normalised estimation error squared per dimension: mean(m_i) / 3; 1 when calibrated, above when overconfident."""
    return float(np.mean(mahalanobis) / 3) if len(mahalanobis) else float("nan")


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Rank correlation: Pearson's of the ranks, ties sharing their mean rank; NaN when one of them is constant."""
    ranks = rankdata(a), rankdata(b)
    a, b = (rank - rank.mean() for rank in ranks)
    scale = np.sqrt((a**2).sum() * (b**2).sum())
    return float((a * b).sum() / scale) if scale > 0 else float("nan")


class SurfaceDistance:
    """Exact distances of points to a moving triangle mesh; the search tree is built once and refitted to every frame.

    Args:
        mesh: its faces and the vertices of some pose.
    """

    def __init__(self, mesh: Mesh):
        self._tree = proximity.build(mesh)

    def __call__(self, points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """min over all triangles of |point - closest point of the triangle|.

        Args:
            points: (N, 3) metres.
            vertices: (V, 3) of this frame, metres.

        Returns:
            (N,) metres, never negative.
        """
        surface = proximity.refresh(self._tree, vertices)
        points = np.ascontiguousarray(points, np.float64)
        return np.abs(proximity.closest_points(self._tree, surface, points, radius=np.inf).distance)


def _difference(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    estimate, truth = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if estimate.shape != truth.shape or estimate.ndim != 2 or estimate.shape[1] != 3:
        raise InvalidArgument("estimate", f"shape {truth.shape} as the truth", str(estimate.shape))
    return estimate - truth

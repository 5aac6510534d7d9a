"""How good an estimate is. E estimate, T truth, n vertices; positions in metres, errors reported in millimetres.

``docs/metrics.md`` lists every metric with its formula and unit.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammainc
from scipy.stats import rankdata

from ddakf.errors import InvalidArgument
from ddakf.mesh import Mesh, vertex_normals
from ddakf.physics import bend, proximity, self_collision

CHI2_3_90 = 6.2514  # 0.9 quantile of the chi-square distribution with 3 degrees of freedom
MM = 1e3  # millimetres per metre
LOG_2PI = float(np.log(2 * np.pi))


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


def nominal_probability(mahalanobis: np.ndarray) -> np.ndarray:
    """Probability content of the smallest claimed ellipsoid that holds the truth: the chi-square distribution function with
    3 degrees of freedom at m_i; uniform in [0, 1] when calibrated."""
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


def second_moment(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(3, 3) mean of e e' over the errors e = E_i - T_i, square metres; means over frames weighted by n are those of all."""
    error = _difference(estimate, truth)
    return error.T @ error / max(len(error), 1)


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Rank correlation: Pearson's of the ranks, ties sharing their mean rank; NaN when one of them is constant."""
    ranks = rankdata(a), rankdata(b)
    a, b = (rank - rank.mean() for rank in ranks)
    scale = np.sqrt((a**2).sum() * (b**2).sum())
    return float((a * b).sum() / scale) if scale > 0 else float("nan")


def roc_auc(score: np.ndarray, positive: np.ndarray) -> float:
    """Area under the receiver operating characteristic: the probability that a positive has the higher score than a
    negative, ties counting half (Mann and Whitney 1947).

    Args:
        score: (n,) high where a positive is expected: for a reliability, which is high when all is well, pass its negative.
        positive: (n,) bool.

    Returns:
        0.5 for a score that knows nothing; NaN when there are only positives or only negatives.
    """
    positive = np.asarray(positive, bool)
    n, m = int(positive.sum()), int((~positive).sum())
    if n == 0 or m == 0:
        return float("nan")
    return float((rankdata(score)[positive].sum() - n * (n + 1) / 2) / (n * m))


def flicker_mm(estimates: np.ndarray, truths: np.ndarray) -> float:
    """Restlessness of the error, not of the motion: sqrt(mean_{t,i} |d_{t-1,i} - 2 d_{t,i} + d_{t+1,i}|^2), d = E - T;
    millimetres per frame squared.

    Args:
        estimates, truths: (T, V, 3) consecutive frames, metres.

    Returns:
        NaN with fewer than three frames.
    """
    if len(estimates) < 3:
        return float("nan")
    second = np.diff(np.asarray(estimates, np.float64) - np.asarray(truths, np.float64), 2, axis=0)
    return float(MM * np.sqrt((second**2).sum(axis=2).mean()))


def frames_until_within(error: np.ndarray, reference: np.ndarray, factor: float, hold: int = 3) -> int | None:
    """How many frames pass until an error is within ``factor`` of a reference, and stays there for ``hold`` frames.

    Args:
        error: (n,) per frame, the first one that of the first frame after a disturbance, or of a start.
        reference: (n,) of the run that it is compared with, in the same frames.
        factor: error_k <= factor * reference_k.
        hold: frames in a row; fewer at the end of the run will do.

    Returns:
        1 when it holds from the first frame on; None when it never does.
    """
    within = np.asarray(error) <= factor * np.asarray(reference)
    for first in range(len(within)):
        if within[first : first + hold].all():
            return first + 1
    return None


def crossings(estimate: np.ndarray, truth: np.ndarray, mesh: Mesh) -> int:
    """Vertices that are on another side of the layer next to them than in the truth.

    The layer next to a vertex is the nearest vertex, at most an edge away from it in the truth, of what is not close to it at
    rest: see :mod:`ddakf.physics.self_collision`. Its side is that of the normal there, in each of the two poses.

    Args:
        estimate, truth: (V, 3) metres.
        mesh: the garment, at rest.
    """
    estimate, truth = (np.ascontiguousarray(pose, np.float64) for pose in (estimate, truth))
    layers = self_collision.find(truth, estimate, mesh, np.zeros(len(truth)), 0.0)
    i, j = layers.stencil.T
    return int((np.einsum("ca,ca->c", layers.normal, estimate[i] - estimate[j]) < 0.0).sum())


class ShapeDifference:
    """Strain and bending of one pose of a mesh against another: the rest shape's, or the truth's.

    Args:
        mesh: whose edges and hinges count.
    """

    def __init__(self, mesh: Mesh):
        self._edges, self._hinges = mesh.edges, bend.build(mesh).stencil

    def stretch(self, vertices: np.ndarray, reference: np.ndarray) -> float:
        """mean_e | |e| / |e_reference| - 1 | over the edges, of poses (V, 3); per cent."""
        length, other = (self._lengths(np.asarray(pose, np.float64)) for pose in (vertices, reference))
        return float(100 * np.abs(length / np.maximum(other, 1e-9) - 1).mean())

    def bend(self, vertices: np.ndarray, reference: np.ndarray) -> float:
        """mean_h |theta - theta_reference| over the dihedral angles, the difference wrapped, of poses (V, 3); degrees."""
        angle, other = (self._angles(np.asarray(pose, np.float64)) for pose in (vertices, reference))
        difference = np.abs(angle - other)
        return float(np.degrees(np.minimum(difference, 2 * np.pi - difference).mean()))

    def _lengths(self, vertices: np.ndarray) -> np.ndarray:
        return np.linalg.norm(vertices[self._edges[:, 1]] - vertices[self._edges[:, 0]], axis=1)

    def _angles(self, vertices: np.ndarray) -> np.ndarray:
        """Signed angle between the normals of the two faces of every hinge, radians; 0 when flat."""
        start, end, one, other = (vertices[self._hinges[:, corner]] for corner in range(4))
        edge = end - start
        n1, n2 = np.cross(edge, one - start), np.cross(other - start, edge)
        sine = -np.linalg.norm(edge, axis=1) * (n1 * (other - start)).sum(axis=1)
        return np.arctan2(sine, (n1 * n2).sum(axis=1))


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


class Penetration:
    """How deep a garment is inside a moving body, by the exact signed distance.

    Args:
        body: in some pose.
    """

    def __init__(self, body: Mesh):
        self._tree, self._face = proximity.build(body), None

    def __call__(self, vertices: np.ndarray, body_vertices: np.ndarray) -> tuple[float, float]:
        """Depth max(0, -d_i) with d_i the signed distance to the body, negative inside.

        Args:
            vertices: (V, 3) of the garment, metres.
            body_vertices: (B, 3) of the body in this frame, metres.

        Returns:
            The mean depth over all vertices, millimetres; and the share of the vertices inside.
        """
        surface = proximity.refresh(self._tree, body_vertices)
        hint = self._face if self._face is not None and len(self._face) == len(vertices) else None
        points = np.ascontiguousarray(vertices, np.float64)
        found = proximity.closest_points(self._tree, surface, points, radius=np.inf, hint=hint)
        self._face = found.face
        return float(MM * np.maximum(-found.distance, 0).mean()), float((found.distance < 0).mean())


def _difference(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    estimate, truth = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if estimate.shape != truth.shape or estimate.ndim != 2 or estimate.shape[1] != 3:
        raise InvalidArgument("estimate", f"shape {truth.shape} as the truth", str(estimate.shape))
    return estimate - truth

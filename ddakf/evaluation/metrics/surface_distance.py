"""Surface distance: distances of points to the faces of a mesh, not only to its vertices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.body import proximity
from ddakf.evaluation.metrics.vertex_error import MM
from ddakf.mesh import Mesh


class Residual(NamedTuple):
    """Distances of a frame's points to the estimated surface, millimetres: the only error without a truth.

    It includes the sensor's noise. It is small for any surface through the points, even if vertices slid within the surface or
    the surface is wrong where there are no points.
    """

    mean_mm: float
    p95_mm: float


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

    def residual(self, points: np.ndarray, vertices: np.ndarray) -> Residual:
        """Mean and 95th percentile of the distances.

        Args:
            points: (N, 3) metres. vertices: (V, 3) of this frame, metres.

        Returns:
            NaN where there are no points.
        """
        if len(points) == 0:
            return Residual(*2 * [float("nan")])
        distance = MM * self(points, vertices)
        return Residual(float(distance.mean()), float(np.percentile(distance, 95)))

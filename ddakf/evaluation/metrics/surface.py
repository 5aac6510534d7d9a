"""Distances to the surface between the vertices."""

from __future__ import annotations

import numpy as np

from ddakf.mesh import Mesh
from ddakf.physics import proximity


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

"""A garment against the body in it."""

from __future__ import annotations

import numpy as np

from ddakf.evaluation.metrics.error import MM
from ddakf.mesh import Mesh
from ddakf.physics import proximity


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

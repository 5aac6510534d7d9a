"""Penetration: depth of a garment's vertices inside the body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.body import proximity
from ddakf.evaluation.metrics.vertex_error import MM
from ddakf.mesh import Mesh


class Depth(NamedTuple):
    """Penetration depth in one frame."""

    mean_mm: float  # over all vertices
    violating_mm: float  # over those inside alone, as in the paper; NaN where there are none
    share: float  # of the vertices that are inside


def violating_mm(mean_mm: float, share: float) -> float:
    """Mean depth of the vertices inside, from the mean over all vertices and the share inside. Both may be means over a run's
    frames; all violations then count alike, in any frame. NaN without any."""
    return float(mean_mm / share) if share > 0 else float("nan")


class Penetration:
    """Penetration of a garment into a moving body, by the exact signed distance.

    Args:
        body: in any pose.
    """

    def __init__(self, body: Mesh):
        self._tree, self._face = proximity.build(body), None

    def __call__(self, vertices: np.ndarray, body_vertices: np.ndarray) -> tuple[float, float]:
        """:meth:`depth` without its second entry."""
        depth = self.depth(vertices, body_vertices)
        return depth.mean_mm, depth.share

    def depth(self, vertices: np.ndarray, body_vertices: np.ndarray) -> Depth:
        """Depth max(0, -d_i) with d_i the signed distance to the body, negative inside.

        Args:
            vertices: (V, 3) of the garment, metres.
            body_vertices: (B, 3) of the body in this frame, metres.

        Returns:
            NaN where a vertex of the garment is not finite.
        """
        if not np.isfinite(vertices).all():
            return Depth(*3 * [float("nan")])
        surface = proximity.refresh(self._tree, body_vertices)
        hint = self._face if self._face is not None and len(self._face) == len(vertices) else None
        points = np.ascontiguousarray(vertices, np.float64)
        found = proximity.closest_points(self._tree, surface, points, radius=np.inf, hint=hint)
        self._face = found.face
        mean, share = float(MM * np.maximum(-found.distance, 0).mean()), float((found.distance < 0).mean())
        return Depth(mean, violating_mm(mean, share), share)

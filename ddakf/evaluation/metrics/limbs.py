"""Limbs: how far joints that are attached to a surface are from those of a body tracker."""

from __future__ import annotations

import numpy as np

from ddakf.evaluation.metrics.vertex_error import MM

DEEPEST = 0.12  # m: a joint farther from the surface at the start is not of what the surface shows
PATCH = 0.02  # m: a joint is attached to the vertices that are at most this much farther from it than the nearest one
FEWEST = 4  # vertices of a patch
MOVED = 0.15  # m from its start: a joint that has moved


class Limbs:
    """Joints that go with the patches of a surface which are next to them at the start.

    Each joint follows the rigid motion of its patch (Kabsch 1976). It is as good as the body tracker: that of the first Kinect is
    a few centimetres off.

    Args:
        vertices: (V, 3) metres, the surface at the start.
        joints: (J, 3) metres, at the start.
    """

    def __init__(self, vertices: np.ndarray, joints: np.ndarray):
        self._start = np.asarray(joints, np.float64)
        self._vertices = np.asarray(vertices, np.float64)
        distances = np.linalg.norm(self._start[:, None] - self._vertices[None], axis=2)
        nearest = distances.min(axis=1)
        self._patches = [
            np.flatnonzero(row <= least + PATCH) if least <= DEEPEST else np.empty(0, int)
            for row, least in zip(distances, nearest, strict=True)
        ]

    def joints(self, vertices: np.ndarray) -> np.ndarray:
        """(J, 3) metres, the joints with the surface at (V, 3) metres; NaN for those that are not of it."""
        found = np.full_like(self._start, np.nan)
        vertices = np.asarray(vertices, np.float64)
        for k, patch in enumerate(self._patches):
            if len(patch) >= FEWEST:
                before, after = self._vertices[patch], vertices[patch]
                u, _, vt = np.linalg.svd((after - after.mean(axis=0)).T @ (before - before.mean(axis=0)))
                u[:, 2] *= np.sign(np.linalg.det(u @ vt))
                found[k] = after.mean(axis=0) + (u @ vt) @ (self._start[k] - before.mean(axis=0))
        return found

    def error_mm(self, vertices: np.ndarray, tracked: np.ndarray) -> tuple[float, float]:
        """Mean distance of the joints to the body tracker's.

        Args:
            vertices: (V, 3) metres. tracked: (J, 3) metres, of the body tracker.

        Returns:
            Over all joints of the surface, and over those that are more than :data:`MOVED` from their start, millimetres; NaN
            where there is none.
        """
        tracked = np.asarray(tracked, np.float64)
        distance = MM * np.linalg.norm(self.joints(vertices) - tracked, axis=1)
        known = np.isfinite(distance)
        moved = known & (np.linalg.norm(tracked - self._start, axis=1) > MOVED)
        return tuple(float(distance[chosen].mean()) if chosen.any() else float("nan") for chosen in (known, moved))

"""The body beside the garment: what it carries along (stage A) and what it pushes out (stage E)."""

from __future__ import annotations

import numpy as np

from ddakf.mesh import Mesh
from ddakf.physics import proximity

COLLISION_REACH = 0.05  # m: a vertex deeper inside the body than this is left to the measurements


class BodyContact:
    """The body's pose, its closest-point structure, and the velocity with which it carries each vertex.

    Args:
        mesh: the body in the pose of the start.
        reach: body surface within it carries the garment, metres.
    """

    def __init__(self, mesh: Mesh, reach: float):
        self._body = proximity.build(mesh)
        self._mesh, self._reach = mesh, reach
        self.reset()

    def reset(self) -> None:
        """Back to the pose of the start."""
        self.vertices = self._mesh.vertices.copy()
        self._surface = proximity.refresh(self._body, self.vertices)
        self.active = False
        self._contact: proximity.Contact | None = None

    def carry(self, position: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """(V, 3) metres: how the body's motion to its next pose, (B, 3) ``vertices``, displaces a garment at ``position``.

        The body is left as it was: :meth:`move` takes the step.
        """
        if self._reach == 0.0:
            return np.zeros_like(position)
        contact = proximity.closest_points(self._body, self._surface, position, self._reach, self._hint(position))
        return proximity.surface_motion(self._body, self.vertices, vertices, position, contact, self._reach).position - position

    def move(self, vertices: np.ndarray | None) -> None:
        """The body's pose in this frame; None: it is not known, and nothing collides."""
        self.active = vertices is not None
        if vertices is not None:
            self.vertices = vertices
            self._surface = proximity.refresh(self._body, vertices)

    def nearest(self, position: np.ndarray) -> proximity.Contact:
        """Closest points on the body for (V, 3) ``position``."""
        self._contact = proximity.closest_points(
            self._body, self._surface, position, COLLISION_REACH, self._hint(position)
        )
        return self._contact

    def _hint(self, position: np.ndarray) -> np.ndarray | None:
        same = self._contact is not None and len(self._contact.face) == len(position)
        return self._contact.face if same else None

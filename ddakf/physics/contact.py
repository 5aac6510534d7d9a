"""The body beside the garment: what it carries along (stage A) and what it pushes out (stage E)."""

from __future__ import annotations

import numpy as np

from ddakf.mesh import Mesh
from ddakf.physics import proximity
from ddakf.types import State

COLLISION_REACH = 0.05  # m: where the body does not carry, it pushes out what is no deeper inside than this


class BodyContact:
    """The body's pose, its closest-point structure, and the velocity with which it carries each vertex.

    Args:
        mesh: the body in the pose of the start.
        reach: body surface within it carries the garment, metres.
    """

    def __init__(self, mesh: Mesh, reach: float):
        self._body = proximity.build(mesh)
        self._mesh, self._carries = mesh, reach > 0.0
        self._reach = reach if reach > 0.0 else COLLISION_REACH
        self.reset()

    def reset(self) -> None:
        """Back to the pose of the start."""
        self.vertices = self._mesh.vertices.copy()
        self._surface = proximity.refresh(self._body, self.vertices)
        self.present = True  # the pose is that of the last frame
        self._velocity: np.ndarray | None = None
        self.held: proximity.Contact | None = None  # closest points when last asked for
        self._asked_at: np.ndarray | None = None  # (V, 3) m, the position then

    def carry(self, state: State, vertices: np.ndarray | None, dt: float) -> tuple[State, np.ndarray | None]:
        """What the body's motion does to a garment, and the state whose velocities are relative to it.

        Args:
            state: posterior of the last frame; its velocities are relative to the body if that frame had one.
            vertices: (B, 3) the body now, metres; None: its pose is not known.
            dt: seconds since the last frame.

        Returns:
            The state, and the displacement (V, 3) in metres; None without a body. A garment whose body is no longer seen
            takes the body's last velocity over into its own.
        """
        if vertices is None or not self.present or not self._carries:
            if self._velocity is not None:
                state = state._replace(velocity=state.velocity + self._velocity)
            self._velocity = None
            return state, None
        position = state.position
        # the closest points of the last frame's prediction: the correction moved the garment along the body by millimetres
        contact = self.nearest(position) if self.held is None else self.held
        motion = proximity.surface_motion(self._body, self.vertices, vertices, position, contact, self._reach)
        displacement = motion.position - position
        self._velocity = displacement / dt
        return state, displacement

    def move(self, vertices: np.ndarray | None) -> None:
        """The body's pose in this frame; None: it is not known, and nothing collides."""
        self.present = vertices is not None
        if vertices is None:
            self.held = None
        if vertices is not None:
            self.vertices = vertices
            self._surface = proximity.refresh(self._body, vertices, self._surface)

    def nearest(self, position: np.ndarray) -> proximity.Contact:
        """Closest points on the body for (V, 3) ``position``; they are held for what follows."""
        hint = None if self.held is None else self.held.face
        self.held = proximity.closest_points(self._body, self._surface, position, self._reach, hint)
        self._asked_at = position.copy()
        return self.held

    def touching(self, position: np.ndarray, thickness: float) -> proximity.Contact:
        """As :meth:`nearest` for all vertices that may be closer than ``thickness`` metres; the others keep their points.

        A signed distance changes by no more than the vertex has moved since it was asked for.
        """
        moved = np.sqrt(np.einsum("va,va->v", position - self._asked_at, position - self._asked_at))
        near = np.flatnonzero(self.held.distance - moved < thickness)
        found = proximity.closest_points(
            self._body, self._surface, position[near], self._reach, self.held.face[near]
        )
        for held, new in zip(self.held, found, strict=True):
            held[near] = new
        self._asked_at[near] = position[near]
        return self.held

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What changes from frame to frame, for a snapshot."""
        arrays = {"contact_vertices": self.vertices, "contact_present": np.array(self.present)}
        if self._velocity is not None:
            arrays["contact_velocity"] = self._velocity
        if self.held is not None:
            arrays |= {f"contact_{name}": value for name, value in self.held._asdict().items()}
        return arrays

    def from_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of :meth:`to_arrays`.

        Raises:
            ValueError: a pose that is not of this body.
        """
        vertices = arrays["contact_vertices"]
        if vertices.shape != self._mesh.vertices.shape or not np.isfinite(vertices).all():
            raise ValueError(f"contact_vertices of shape {vertices.shape} is no pose of the body")
        self.vertices = vertices
        self._surface = proximity.refresh(self._body, self.vertices)
        self.present = bool(arrays["contact_present"])
        self._velocity = arrays.get("contact_velocity")
        self.held = None
        if "contact_face" in arrays:
            self.held = proximity.Contact(*(arrays[f"contact_{name}"] for name in proximity.Contact._fields))

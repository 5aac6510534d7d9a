"""The body beside the garment: what it carries along (stage A) and what it pushes out (stage E)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.body import proximity
from ddakf.config import Physics
from ddakf.mesh import Mesh
from ddakf.types import State

COLLISION_REACH = 0.05  # m: where the body does not carry, it pushes out what is no deeper inside than this
DEEPEST = 0.03  # m: more than this inside is no error of a body model
BOUND_REACH = 0.3  # m: body surface within it is where a vertex is bound to it


class Bound(NamedTuple):
    """A garment on the body in one pose."""

    pose: np.ndarray  # (B, 3) m, the body
    position: np.ndarray  # (V, 3) m, the garment
    contact: proximity.Contact  # the closest point of each vertex within BOUND_REACH


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
        self._hint: np.ndarray | None = None  # (V,) int32 faces that are probably close; makes a search faster, no different
        self.gap: np.ndarray | None = None  # (V,) m, signed distance that each vertex keeps at least; None: the thickness

    def start(self, position: np.ndarray, thickness: float) -> None:
        """Vertices that start closer than the thickness may stay as close.

        A body model is wrong by centimetres in places, and a garment reconstructed beside it lies inside it there, the same
        vertices all the time. Pushed out by the thickness, the unseen half of a shirt inflates. Of a wrong start nothing is
        lost: contact only pushes, so that the vertices come out as soon as anything pulls them.
        """
        self.gap = np.clip(self.nearest(position).distance, -DEEPEST, thickness)
        self.held = self._asked_at = None

    def configured(self, position: np.ndarray, config: Physics) -> None:
        """Gaps as a new configuration has them, of vertices at (V, 3) ``position``, metres."""
        if config.gap_time <= 0:
            self.gap = None
        elif self.gap is None:
            self.start(position, config.thickness)
        else:
            self.gap = np.minimum(self.gap, config.thickness)

    def learn(self, position: np.ndarray, observed: np.ndarray, dt: float, config: Physics) -> None:
        """Where a sensor sees them, vertices may be as close as they turn out to be at (V, 3) ``position``.

        Args:
            position: the estimate, metres.
            observed: (V,) bool, vertices with a measurement.
            dt: seconds since the last frame.
            config: thickness, and the time constant.
        """
        if self.gap is None or self.held is None:
            return
        distance = np.einsum("va,va->v", self.held.normal, position - self.held.point)
        seen = observed & (self.held.face >= 0)
        share = 1.0 - np.exp(-dt / config.gap_time)
        change = np.clip(distance, -DEEPEST, config.thickness) - self.gap
        self.gap = np.where(seen, self.gap + share * change, self.gap)

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
        self.held = None  # in the next pose it is no longer true
        motion = proximity.surface_motion(self._body, self.vertices, vertices, position, contact, self._reach)
        displacement = motion.position - position
        self._velocity = displacement / dt
        return state, displacement

    def bind(self, position: np.ndarray, pose: np.ndarray | None = None) -> Bound:
        """A garment at (V, 3) ``position`` bound to the body in a (B, 3) ``pose``, metres; by default the present one."""
        pose = self.vertices if pose is None else pose
        surface = proximity.refresh(self._body, pose)
        return Bound(pose.copy(), position.copy(), proximity.closest_points(self._body, surface, position, BOUND_REACH))

    def bring(self, bound: Bound) -> np.ndarray:
        """(V, 3) metres: where the body has brought a garment in its present pose that has gone with it ever since."""
        pose, position, contact = bound
        return proximity.surface_motion(
            self._body, pose, self.vertices, position, contact, 2.0 * BOUND_REACH, BOUND_REACH
        ).position

    @property
    def velocity(self) -> np.ndarray | None:
        """(V, 3) m/s with which the body carried each vertex in the last frame; None where it did not."""
        return self._velocity

    def mark(self) -> tuple:
        """What :meth:`back_to` needs; arrays are never written in place between the two."""
        return self.vertices, self.present, self._velocity, self.held, self._asked_at, self.gap

    def back_to(self, mark: tuple) -> None:
        """As it was at the mark: the step since then did not happen."""
        self.vertices, self.present, self._velocity, self.held, self._asked_at, self.gap = mark
        self._surface = proximity.refresh(self._body, self.vertices)

    def move(self, vertices: np.ndarray | None) -> None:
        """The body's pose in this frame; None: it is not known, and nothing collides."""
        self.present = vertices is not None
        self.held = None
        if vertices is not None:
            self.vertices = vertices
            self._surface = proximity.refresh(self._body, vertices, self._surface)

    def nearest(self, position: np.ndarray) -> proximity.Contact:
        """Closest points on the body for (V, 3) ``position``; they are held for what follows."""
        self.held = proximity.closest_points(self._body, self._surface, position, self._reach, self._hint)
        self._hint = self.held.face
        self._asked_at = position.copy()
        return self.held

    def closest(self, position: np.ndarray, thickness: float) -> proximity.Contact:
        """Of all vertices in this pose the first time, then of those that may be closer than ``thickness`` metres."""
        return self.nearest(position) if self.held is None else self.touching(position, thickness)

    def touching(self, position: np.ndarray, thickness: float) -> proximity.Contact:
        """As :meth:`nearest` for all vertices that may be closer than ``thickness`` metres; the others keep their points.

        A signed distance changes by no more than the vertex has moved since it was asked for.
        """
        step = position - self._asked_at
        moved = np.sqrt(np.einsum("va,va->v", step, step))
        near = np.flatnonzero(self.held.distance - moved < thickness)
        if len(near) == 0:
            return self.held
        found = proximity.closest_points(
            self._body, self._surface, position[near], self._reach, self.held.face[near]
        )
        held = proximity.Contact(*(array.copy() for array in self.held))
        for array, new in zip(held, found, strict=True):
            array[near] = new
        self.held, self._asked_at = held, self._asked_at.copy()
        self._asked_at[near] = position[near]
        return self.held

    def planes(self, position: np.ndarray, config: Physics) -> tuple[np.ndarray, np.ndarray] | None:
        """Point and outward normal, (V, 3) each, of the plane that each vertex at ``position`` is kept outside of; None without
        a body. A vertex with no body within reach has a plane that it is outside of wherever it is."""
        if not self.present or config.collision == 0:
            return None
        closest = self.nearest(position)
        least = np.full(len(position), config.thickness) if self.gap is None else self.gap
        point = closest.point + least[:, None] * closest.normal
        return point, closest.normal  # of a vertex with nothing near both are 0

    def within(self, points: np.ndarray, radius: float) -> np.ndarray:
        """(N,) bool: (N, 3) points that lie within ``radius`` metres of the body's surface, on either side."""
        return proximity.closest_points(self._body, self._surface, points, radius).face >= 0

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What changes from frame to frame, for a snapshot."""
        arrays = {"contact_vertices": self.vertices, "contact_present": np.array(self.present)}
        if self._velocity is not None:
            arrays["contact_velocity"] = self._velocity
        if self.held is not None:
            arrays |= {f"contact_{name}": value for name, value in self.held._asdict().items()}
            arrays["contact_asked_at"] = self._asked_at
        if self.gap is not None:
            arrays["contact_gap"] = self.gap
        return arrays

    def from_arrays(self, arrays: dict[str, np.ndarray], n: int) -> None:
        """The inverse of :meth:`to_arrays`.

        Raises:
            ValueError: arrays that do not belong to this body and a garment of ``n`` vertices.
        """
        shapes = {"vertices": self._mesh.vertices.shape, "velocity": (n, 3), "asked_at": (n, 3), "face": (n,), "distance": (n,)}
        shapes |= {"barycentric": (n, 3), "point": (n, 3), "normal": (n, 3), "gap": (n,)}
        for name, shape in shapes.items():
            array = arrays.get(f"contact_{name}")
            if array is not None and (array.shape != shape or np.isnan(array).any()):
                raise ValueError(f"contact_{name} is not of shape {shape} or not a number")
        self.vertices = arrays["contact_vertices"]
        self._surface = proximity.refresh(self._body, self.vertices)
        self.present = bool(arrays["contact_present"])
        self._velocity = arrays.get("contact_velocity")
        self.gap = arrays.get("contact_gap")
        self.held = self._asked_at = None
        if "contact_face" in arrays:
            face = arrays["contact_face"]
            if face.dtype != np.int32 or face.min() < -1 or face.max() >= len(self._body.faces):
                raise ValueError("contact_face is no face of the body")
            self.held = proximity.Contact(*(arrays[f"contact_{name}"] for name in proximity.Contact._fields))
            self._asked_at = arrays["contact_asked_at"]

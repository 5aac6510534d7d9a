"""Body support: what a given body tells a baseline. It carries the prediction, holds hidden vertices, keeps the garment outside.

These are the parts that DD-AKF gets from the body, with the same geometry (:mod:`ddakf.body.contact`), so that a comparison with
the body compares the use of the cloud.
"""

from __future__ import annotations

import numpy as np

from ddakf.body import contact, proximity
from ddakf.config import Anchor, ConstantVelocity, Physics
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

HOLD = 0.1  # of a hidden vertex on the body, against a correspondence of full weight; chosen in benchmarks/results/tuning.json
LOOSE = 0.05  # m from the body at which the hold has fallen to a quarter


class BodySupport:
    """The body's motion since the last frame and since the start, for one garment.

    Args:
        body: in the pose of the start.
        vertices: (V, 3) of the garment there, metres.
        hold: weight of a hidden vertex that touches the body.

    Attributes:
        place: (V, 3) metres, where the body has brought the garment of the start in this frame.
        weight: (V,) in [0, hold], of that place; 0 without a body in this frame.
    """

    def __init__(self, body: Mesh, vertices: np.ndarray, hold: float = HOLD):
        self._physics, self._reach = Physics(), Anchor().reach
        self._model = contact.build(body, ConstantVelocity().carry_reach)
        self._track = contact.start(self._model, np.array(vertices, np.float64), self._physics)
        self._bound = contact.bind(self._model, self._track.vertices, np.array(vertices, np.float64), self._reach)
        found = self._bound.contact
        clearance = np.clip(found.distance, 0.0, self._reach)
        self._hold = np.where(found.face < 0, 0.0, hold * np.square(LOOSE / (LOOSE + clearance)))
        self.place, self.weight, self._pose = np.array(vertices, np.float64), self._hold, None

    def begin(self, frame: CapturedFrame, x: np.ndarray) -> np.ndarray:
        """Starts a frame.

        Returns:
            (V, 3) the garment of the last frame, x (V, 3), carried on by the surface under it; x itself without a body.
        """
        if frame.body_vertices is None:
            self._pose, self.weight = None, np.zeros_like(self._hold)
            return x
        before = contact.posed(self._model, self._track)
        now = np.array(frame.body_vertices, np.float64)
        near = contact.nearest(before, x).closest
        moved = proximity.surface_motion(self._model.tree, before.vertices, now, x, near, self._model.reach)
        self._pose = contact.posed(self._model, self._track, now)
        self._track = self._track._replace(vertices=now)
        self.place, self.weight = contact.follow(self._bound, self._pose, self._reach), self._hold
        return moved.position

    def held(self, matched: np.ndarray) -> np.ndarray:
        """(V,) weights of the places of the vertices without a match; 0 for those with a positive weight in ``matched`` (V,)."""
        return np.where(matched > 0, 0.0, self.weight)

    def outside(self, x: np.ndarray) -> np.ndarray:
        """(V, 3) x with the vertices inside the body moved out along its normal, to the distance at which they may be."""
        if self._pose is None:
            return x
        point, normal = contact.planes(self._pose, contact.nearest(self._pose, x), self._physics)
        depth = np.minimum(np.einsum("va,va->v", x - point, normal), 0.0)
        return x - depth[:, None] * normal


class NoSupport:
    """No body: nothing is carried, held or pushed."""

    def __init__(self, count: int):
        self.place, self.weight = np.zeros((count, 3)), np.zeros(count)

    def begin(self, frame: CapturedFrame, x: np.ndarray) -> np.ndarray:
        """See :meth:`BodySupport.begin`."""
        return x

    def held(self, matched: np.ndarray) -> np.ndarray:
        """See :meth:`BodySupport.held`."""
        return self.weight

    def outside(self, x: np.ndarray) -> np.ndarray:
        """See :meth:`BodySupport.outside`."""
        return x


def support_of(body: Mesh | None, vertices: np.ndarray, hold: float = HOLD) -> BodySupport | NoSupport:
    """The support of a body, or none."""
    return NoSupport(len(vertices)) if body is None else BodySupport(body, vertices, hold)

"""How a garment hangs on its body: where it would be had it gone with the body ever since the start, and how far it deviates.

Prediction rides on the body from frame to frame, and what no sensor sees adds up the errors of all frames. Its place on the body
does not. It is therefore a pseudo-measurement of the vertices that are not seen, and its variance is learned where the garment is
seen, as stage D learns R: a shirt that fits tightly is held, a skirt that swings is not.
"""

from __future__ import annotations

from math import exp
from typing import NamedTuple

import numpy as np

from ddakf.body.contact import BodyContact, Bound
from ddakf.config import ConstantVelocity
from ddakf.garment.model import Model
from ddakf.kernels.associate import vertex_normals
from ddakf.stages.fuse import Planes

LEAST_SD = 0.002  # m: no garment goes with its body more exactly
# of the deviations in a patch, that count as independent: along the normal and across it, as cloth slips over longer lengths
INDEPENDENT = np.array([2.0, 0.7])
LEAST_SEEN = 0.05  # of a patch: as much evidence as the first guess counts for


class Worn(NamedTuple):
    """What is known of one garment on its body. V vertices, L patches."""

    bound: Bound  # the garment on the body, at the start or where it was found
    seen: np.ndarray  # (L,) share of a patch's vertices that was measured lately
    squares: np.ndarray  # (L, 2) m^2, of them the squared deviation along the normal, and along either tangent, times that share
    measured: np.ndarray  # (V,) bool, in the last frame

    @classmethod
    def at(cls, position: np.ndarray, contact: BodyContact, model: Model) -> Worn:
        """A garment at (V, 3) ``position``, metres, on the body in its present pose; nothing is learned yet."""
        n = len(model.likeness)
        return cls(contact.bind(position), np.zeros(n), np.zeros((n, 2)), np.zeros(len(position), bool))

    def held(self, contact: BodyContact, model: Model, config: ConstantVelocity) -> Planes | None:
        """The pseudo-measurements of a frame: the place of each vertex on the body, for those that were not measured lately.

        None where the pose of the body is not known. The deviations of a patch count as :data:`INDEPENDENT` ones, those along
        the normal and across it each with its own variance; a patch of which nothing was seen has that of the patches around it.
        """
        if not contact.present:
            return None
        target = contact.bring(self.bound)
        normal = np.empty_like(target)
        vertex_normals(target, model.faces, normal)
        variance = self._variance(model, config)
        along, across = (len(target) / len(variance) * (variance / INDEPENDENT)[model.patch]).T
        weight = np.where(self.measured | (self.bound.contact.face < 0), 0.0, 1.0)
        return Planes(target, normal, weight, np.ascontiguousarray(along), np.ascontiguousarray(across))

    def slack(self, model: Model, config: ConstantVelocity) -> np.ndarray:
        """(V,) metres: how far, in standard deviations of a place, cloth there is from where the body has brought it."""
        along, across = self._variance(model, config).T
        return np.sqrt(along + 2.0 * across)[model.patch]

    def _variance(self, model: Model, config: ConstantVelocity) -> np.ndarray:
        """(L, 2) m^2 of the deviations in a patch, along the normal and along either tangent."""
        near = model.likeness @ np.column_stack([self.squares, self.seen])
        guess = LEAST_SEEN * config.worn_sd**2
        return np.maximum((near[:, :2] + guess) / (near[:, 2:] + LEAST_SEEN), LEAST_SD**2)

    def learned(
        self, held: Planes | None, position: np.ndarray, measured: np.ndarray, dt: float, model: Model, config: ConstantVelocity
    ) -> Worn:
        """After a frame.

        Args:
            held: of this frame.
            position: (V, 3) the posterior, metres.
            measured: (V,) bool.
            dt: seconds since the last frame.
            model: the garment.
            config: with the time constant.
        """
        if held is None:
            return self
        n, used = len(self.seen), measured & (self.bound.contact.face >= 0)
        patch, deviation = model.patch[used], (position - held.target)[used]
        along = np.square(np.einsum("va,va->v", deviation, held.normal[used]))
        across = 0.5 * (np.einsum("va,va->v", deviation, deviation) - along)
        size = np.bincount(model.patch, minlength=n)
        sums = np.column_stack([np.bincount(patch, weights, n) for weights in (along, across, None)]) / size[:, None]
        kept = exp(-dt / config.worn_memory)
        return Worn(
            self.bound,
            kept * self.seen + (1.0 - kept) * sums[:, 2],
            kept * self.squares + (1.0 - kept) * sums[:, :2],
            measured,
        )


def holds(config: ConstantVelocity) -> bool:
    """Whether a body holds what is not seen."""
    return config.carry_reach > 0 and config.worn_memory > 0

"""Stage E, all energies of a garment at once (paper, section 2.4)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.config import Physics
from ddakf.model import Model
from ddakf.physics import Linearization, bend, collision, diagonal_blocks, gradient, shear, stretch
from ddakf.physics.contact import BodyContact


class Energies(NamedTuple):
    """The cloth energies, linearised at one position, and the stiffness of each (lambda and fabric included)."""

    stretch: Linearization
    shear: Linearization
    bend: Linearization
    collision: Linearization | None
    stiffness: tuple[float, float, float, float]

    def parts(self) -> list[tuple[Linearization, float]]:
        """Each energy that acts, with its stiffness."""
        pairs = zip(self[:4], self.stiffness, strict=True)
        return [(part, stiffness) for part, stiffness in pairs if part is not None and stiffness > 0]


def linearize(
    position: np.ndarray, last: Energies | None, model: Model, contact: BodyContact | None, physics_lambda: float,
    config: Physics,
) -> Energies:  # fmt: skip
    """All energies at ``position`` (V, 3) metres, multiplied by lambda; collision is not, it is a bound and no preference.

    Bending is linearised once per frame: it is the dearest of the energies, and the angles change little from pass to pass.

    Args:
        position: the estimate.
        last: of the pass before, or None in the first.
        model: the garment.
        contact: the body, or None.
        physics_lambda: of stage G.
        config: stiffnesses and fabric.
    """
    touching = None
    if contact is not None and contact.present and config.collision > 0:
        thickness = model.collision.thickness
        closest = contact.nearest(position) if last is None else contact.touching(position, thickness)
        touching = collision.linearize(position, model.collision, closest)
    fabric = config.fabric
    return Energies(
        softened(stretch.linearize(position, model.stretch), config.strain_scale),
        shear.linearize(position, model.shear),
        bend.linearize(position, model.bend) if last is None else last.bend,
        touching,
        (
            physics_lambda * config.stretch * fabric.stretch,
            physics_lambda * config.shear * fabric.shear,
            physics_lambda * config.bend * fabric.bend,
            config.collision,
        ),
    )


def softened(part: Linearization, scale: float) -> Linearization:
    """The same constraints with Cauchy pseudo-noise: weight w / (1 + q) of energy w scale^2 / 2 log(1 + q), q = (r / scale)^2.

    A template is a guess: real recordings stretch by tens of per cent where seams, poses or a reconstruction disagree with it,
    and a quadratic energy would give all its force to those.
    """
    return part._replace(weight=part.weight / (1.0 + np.square(part.residual / scale)))


def total_gradient(energies: Energies, n: int) -> np.ndarray:
    """(V, 3) h_phys = dE/dp, section 2.4."""
    total = np.zeros((n, 3))
    for part, stiffness in energies.parts():
        gradient(part._replace(weight=stiffness * part.weight), n, total)
    return total


def total_blocks(energies: Energies, n: int) -> np.ndarray:
    """(V, 3, 3) H_phys,i: how fast h_phys of a vertex changes, its neighbours moving as it does at worst.

    The Gauss-Newton blocks of every energy, times the vertices of its stencil: with that factor steps that all vertices take at
    the same time never overshoot (Cauchy-Schwarz on the terms of a constraint).
    """
    total = np.zeros((n, 3, 3))
    for part, stiffness in energies.parts():
        share = stiffness * part.stencil.shape[1]
        diagonal_blocks(part._replace(weight=share * part.weight), n, total)
    return total

"""Stage E, all energies of a garment at once (paper, section 2.4)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.body.contact import BodyContact
from ddakf.config import Physics
from ddakf.garment.model import Model
from ddakf.physics import Linearization, bend, collision, diagonal_blocks, gradient, self_collision, shear, stretch


class Energies(NamedTuple):
    """The cloth energies at one position, and the stiffness of each (lambda and fabric included).

    Stretch, shear and bending are not linearised here: the fused update takes their blocks straight from the position.
    """

    position: np.ndarray  # (V, 3) m
    bending: bend.Hinges  # of the frame's first pass
    collision: Linearization | None
    stiffness: tuple[float, float, float, float]  # of stretch, shear, bend and collision
    strain_scale: float  # of stretch, see :func:`softened`
    layers: self_collision.Layers | None = None
    self_collision: Linearization | None = None  # as stiff as self_stiffness
    self_stiffness: float = 0.0

    def parts(self, model: Model) -> list[tuple[Linearization, float]]:
        """Each energy that acts, linearised, with its stiffness."""
        stretched = softened(stretch.linearize(self.position, model.stretch), self.strain_scale)
        sheared, bent = shear.linearize(self.position, model.shear), bend.linearize(self.position, model.bend)
        linear = (stretched, sheared, bent, self.collision, self.self_collision)
        pairs = zip(linear, (*self.stiffness, self.self_stiffness), strict=True)
        return [(part, stiffness) for part, stiffness in pairs if part is not None and stiffness > 0]


def linearize(
    position: np.ndarray, last: Energies | None, model: Model, contact: BodyContact | None, physics_lambda: float,
    config: Physics, before: np.ndarray | None = None,
) -> Energies:  # fmt: skip
    """All energies at ``position`` (V, 3) metres, multiplied by lambda; collision is not, it is a bound and no preference.

    Bending is linearised once per frame: it is the dearest of the energies, and the angles change little from pass to pass. So
    are the pairs of self-collision found.

    Args:
        position: the estimate.
        last: of the pass before, or None in the first.
        model: the garment.
        contact: the body, or None.
        physics_lambda: of stage G.
        config: stiffnesses and fabric.
        before: (V, 3) after the last frame, metres; None: the layers of the garment do not collide.
    """
    touching = layers = folded = None
    if config.self_collision > 0 and before is not None:
        share, thickness = model.collision.weight, model.collision.thickness
        layers = self_collision.find(before, position, model.mesh, share, thickness) if last is None else last.layers
        folded = self_collision.linearize(position, layers)
    if contact is not None and contact.present and config.collision > 0:
        closest = contact.closest(position, model.collision.thickness)
        touching = collision.linearize(position, model.collision, closest, contact.gap)
    fabric = config.fabric
    stiffness = (
        physics_lambda * config.stretch * fabric.stretch,
        physics_lambda * config.shear * fabric.shear,
        physics_lambda * config.bend * fabric.bend,
        config.collision,
    )
    bending = bend.summed(position, model.bend, stiffness[2]) if last is None else last.bending
    return Energies(position, bending, touching, stiffness, config.strain_scale, layers, folded, config.self_collision)


def softened(part: Linearization, scale: float) -> Linearization:
    """The same constraints with Cauchy pseudo-noise: weight w / (1 + q) of energy w scale^2 / 2 log(1 + q), q = (r / scale)^2.

    A template is a guess: real recordings stretch by tens of per cent where seams, poses or a reconstruction disagree with it,
    and a quadratic energy would give all its force to those.
    """
    return part._replace(weight=part.weight / (1.0 + np.square(part.residual / scale)))


def total_gradient(energies: Energies, model: Model) -> np.ndarray:
    """(V, 3) h_phys = dE/dp, section 2.4."""
    n = len(energies.position)
    total = np.zeros((n, 3))
    for part, stiffness in energies.parts(model):
        gradient(part._replace(weight=stiffness * part.weight), n, total)
    return total


def total_blocks(energies: Energies, model: Model) -> np.ndarray:
    """(V, 3, 3) H_phys,i: how fast h_phys of a vertex changes, its neighbours moving as it does at worst.

    The Gauss-Newton blocks of every energy, times the vertices of its stencil: with that factor steps that all vertices take at
    the same time never overshoot (Cauchy-Schwarz on the terms of a constraint).
    """
    n = len(energies.position)
    total = np.zeros((n, 3, 3))
    for part, stiffness in energies.parts(model):
        share = stiffness * part.stencil.shape[1]
        diagonal_blocks(part._replace(weight=share * part.weight), n, total)
    return total

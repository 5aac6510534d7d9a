"""Stage E, all energies of a garment at once (paper, section 2.4)."""

from __future__ import annotations

import numpy as np

from ddakf.body import contact, floor
from ddakf.physics import Linearization, bend, collision, diagonal_blocks, gradient, self_collision, shear, stretch
from ddakf.types import Energies, Estimate, Model, Problem


def parts(energies: Energies, model: Model) -> list[tuple[Linearization, float]]:
    """Each energy that acts, linearised, with its stiffness."""
    stretched = softened(stretch.linearize(energies.position, model.stretch), energies.strain_scale)
    sheared, bent = shear.linearize(energies.position, model.shear), bend.linearize(energies.position, model.bend)
    linear = (stretched, sheared, bent, energies.collision, energies.self_collision)
    pairs = zip(linear, (*energies.stiffness, energies.self_stiffness), strict=True)
    return [(part, stiffness) for part, stiffness in pairs if part is not None and stiffness > 0]


def linearize(problem: Problem, estimate: Estimate) -> Energies:
    """All energies at the estimate, multiplied by lambda; collision is not, it is a bound and no preference.

    Bending is linearised once per frame: it is the dearest of the energies, and the angles change little from pass to pass.
    The pairs of self-collision are found once per frame as well.
    """
    position, model, config, last = estimate.position, problem.model, problem.config.physics, estimate.terms.forces
    physics_lambda, contacts = problem.health.physics_lambda, estimate.contacts
    touching = layers = folded = None
    if config.self_collision > 0:
        layers = None if last is None else last.layers
        if layers is None:
            layers = self_collision.find(problem.motion_start, position, model.layers)
        folded = self_collision.linearize(position, layers)
    if problem.body is not None and config.collision > 0:
        contacts = contact.nearest_from_last(problem, position) if contacts is None else contacts
        contacts = contact.closest(problem.body, position, contacts, model.collision.thickness)
        yielding = config.collision * contact.variances(problem)
        touching = collision.linearize(position, model.collision, contacts.closest, problem.body.gap, yielding)
        on_floor = floor.linearize(problem, position)
        if on_floor is not None:
            touching = Linearization(*(np.concatenate(pair) for pair in zip(touching, on_floor, strict=True)))
    in_plane = physics_lambda * config.in_plane
    stiffness = in_plane, in_plane, physics_lambda * config.bend * config.fabric.bend, config.collision
    bending = bend.summed(position, model.bend, stiffness[2]) if last is None else last.bending
    return Energies(
        position, bending, touching, stiffness, config.strain_scale, layers, folded, config.self_collision, contacts
    )


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
    for part, stiffness in parts(energies, model):
        gradient(part._replace(weight=stiffness * part.weight), n, total)
    return total


def total_blocks(energies: Energies, model: Model) -> np.ndarray:
    """(V, 3, 3) H_phys,i: how fast h_phys of a vertex changes, its neighbours moving as it does at worst.

    The Gauss-Newton blocks of every energy, times the vertices of its stencil: with that factor steps that all vertices take at
    the same time never overshoot (Cauchy-Schwarz on the terms of a constraint).
    """
    n = len(energies.position)
    total = np.zeros((n, 3, 3))
    for part, stiffness in parts(energies, model):
        share = stiffness * part.stencil.shape[1]
        diagonal_blocks(part._replace(weight=share * part.weight), n, total)
    return total

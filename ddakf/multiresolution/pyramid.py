"""Pyramid, stages B to F on decimated levels of the garment, before all its vertices take part.

Each level has about a quarter of the vertices of the next finer one: its passes cost a quarter, and carry a correction twice as
far. The coarser level only tells where the next finer one begins; the prior stays the prediction.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from ddakf.body import contact
from ddakf.config import Config, PlaneAssociation, Pyramid
from ddakf.kernels import pyramid as kernels
from ddakf.physics import Linearization, energies
from ddakf.stages import associate, fuse, robust, skin_removal
from ddakf.types import Coarser, Estimate, Evidence, Measurement, Model, Planes, Problem, State


class Level(NamedTuple):
    """The garment, or one of its decimated levels, before its passes. W vertices."""

    problem: Problem  # on the level's vertices
    position: np.ndarray  # (W, 3) m
    floor: tuple[np.ndarray, np.ndarray] | None  # point and normal of the body beside each vertex
    stands_for: float  # vertices of the garment that one of the level stands for


def descend(problem: Problem, estimate: Estimate) -> Estimate:
    """The estimate before the first pass over all vertices.

    Nothing is done by the paper's association, which has no normals, and on the cloud of a whole person: the edges of decimated
    levels are too long to tell cloth from the skin beside it.
    """
    config, model = problem.config, problem.model
    if problem.cloud.empty or not isinstance(config.associate, PlaneAssociation) or skin_removal.of_person(problem):
        return estimate
    if config.pyramid.iterations == 0 or model.coarser is None:
        return estimate
    floor = None
    if problem.body is not None and config.physics.collision > 0:
        estimate = estimate._replace(contacts=contact.nearest(problem.body, estimate.position, estimate.contacts))
        floor = contact.planes(problem.body, estimate.contacts, config.physics)
    visible = estimate.evidence.measurement.visible
    if visible is None:
        visible = associate.visible(problem, estimate.position)
    garment = problem._replace(
        config=_coarsened(config, config.pyramid), body=None, visible=visible, rotation=estimate.rest.rotation
    )
    position, passes = _from_below(Level(garment, estimate.position, floor, 1.0), model.coarser)
    return estimate._replace(position=position, passes=passes)


def _coarsened(config: Config, rule: Pyramid) -> Config:
    """The physics of levels, whose edges are longer than wrinkles: cloth that shrinks and stretches by them."""
    physics = dataclasses.replace(
        config.physics,
        stretch=rule.strain * config.physics.stretch,
        shear=rule.strain * config.physics.shear,
        rest_rigidity=rule.rest * config.physics.rest_rigidity,
        motion_rigidity=rule.motion * config.physics.motion_rigidity,
        self_collision=0.0,
    )
    return dataclasses.replace(config, physics=physics)


def _decimated(level: Level, coarser: Coarser) -> Level:
    """The next coarser level."""
    problem, vertex = level.problem, coarser.vertex
    prior, anchored, floor = State(*(array[vertex] for array in problem.prior)), problem.anchored, level.floor
    stands_for = level.stands_for * (len(level.position) / len(vertex))
    coarse = problem._replace(
        model=coarser.model,
        prior=prior,
        state=prior,
        motion_start=problem.motion_start[vertex],
        rotation=problem.rotation[vertex],
        visible=problem.visible[vertex],
        anchored=None if anchored is None else Planes(*(array[vertex] for array in anchored[:5])),
    )
    return Level(coarse, level.position[vertex], None if floor is None else (floor[0][vertex], floor[1][vertex]), stands_for)


def _from_below(level: Level, coarser: Coarser) -> tuple[np.ndarray, int]:
    """(V, 3) position of a level after the passes of the coarser ones, and their number."""
    below = _decimated(level, coarser)
    begin, done = below.position, 0
    if coarser.model.coarser is not None:
        begin, done = _from_below(below, coarser.model.coarser)
    found, passes = _passes(below, begin, done)
    moved = np.empty_like(level.position)
    kernels.interpolate(level.position, found - below.position, coarser.corner, coarser.share, moved)
    return moved, done + passes


def _passes(level: Level, begin: np.ndarray, done: int) -> tuple[np.ndarray, int]:
    """(W, 3) position of a level after its own passes from ``begin``, and their number; ``done`` passes were coarser."""
    problem, stands_for = level.problem, level.stands_for
    if problem.anchored is not None:
        problem = problem._replace(anchored=problem.anchored._replace(weight=stands_for * problem.anchored.weight))
    rule, prior = problem.config.pyramid, problem.prior
    estimate = fuse.begin(problem)
    estimate = estimate._replace(position=begin, information=stands_for * estimate.information)
    for gate in associate.gates(problem, 1 if done else 0):
        measurement = associate.associate(problem, estimate, gate)
        weight = robust.weigh(problem, estimate, measurement)
        forces = energies.linearize(problem, estimate)
        forces = forces._replace(collision=_pushed_out(estimate.position, level.floor, problem.model))
        evidence = Evidence(_denser(measurement, stands_for), stands_for * weight, prior.R, forces)
        estimate = fuse.fuse(problem, estimate, evidence, gate)
        if estimate.rejected:
            return begin, estimate.passes
        step = np.square(estimate.position - estimate.before[0]).sum() / len(begin)
        if estimate.passes == 1 and step < rule.tolerance**2:
            return begin, 1  # good already; the coarser shape's other preferences must not add up over the frames
        if estimate.passes >= rule.iterations or step < rule.tolerance**2:
            break
    return estimate.position, estimate.passes


def _denser(measurement: Measurement, stands_for: float) -> Measurement:
    """Hems as stiff per length as those of the garment: along a line vertices thin out by a root of what they do on a surface."""
    hem = measurement.hem
    return measurement if hem is None else measurement._replace(hem=hem._replace(weight=np.sqrt(stands_for) * hem.weight))


def _pushed_out(position: np.ndarray, floor: tuple[np.ndarray, np.ndarray] | None, model: Model) -> Linearization | None:
    """The body's planes as constraints on vertices inside."""
    if floor is None:
        return None
    point, normal = floor
    residual = np.minimum(np.einsum("va,va->v", normal, position - point), 0.0)
    constants = model.collision
    return Linearization(constants.stencil, residual, normal[:, None, :], np.where(residual < 0.0, constants.weight, 0.0))

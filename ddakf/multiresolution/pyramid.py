"""Stages B to F on coarser versions of the garment, before all its vertices take part.

Each version has about a quarter of the vertices of the next finer one: its passes cost a quarter, and carry a correction twice as
far. What they find is only where the next finer one begins; the prior stays the prediction.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from ddakf.body.contact import BodyContact
from ddakf.config import Config, PlaneAssociation, Pyramid
from ddakf.garment.model import Coarser, Model
from ddakf.kernels import pyramid as kernels
from ddakf.physics import Linearization, energies
from ddakf.stages import associate, fuse, robust
from ddakf.stages.associate import Measurement
from ddakf.stages.fuse import Planes, Update
from ddakf.stages.preprocess import Cloud
from ddakf.types import State


class Shared(NamedTuple):
    """What all levels measure."""

    cloud: Cloud
    physics_lambda: float
    config: Config  # as the coarser versions take it


class Level(NamedTuple):
    """The garment, or a version of it, before its passes. W vertices."""

    position: np.ndarray  # (W, 3) m
    last: np.ndarray  # (W, 3) m, posterior of the last frame
    rotation: np.ndarray  # (W, 3, 3) of the one-rings against rest
    prior: State
    visible: np.ndarray  # (W,) bool, vertices that a sensor may see
    floor: tuple[np.ndarray, np.ndarray] | None  # point and normal of the body beside each vertex
    held: Planes | None  # pseudo-measurements, see Update

    def thinned(self, vertex: np.ndarray) -> Level:
        """On some of the vertices."""
        floor = None if self.floor is None else (self.floor[0][vertex], self.floor[1][vertex])
        held = None if self.held is None else Planes(*(array[vertex] for array in self.held[:5]))
        prior = State(*(array[vertex] for array in self.prior))
        return Level(self.position[vertex], self.last[vertex], self.rotation[vertex], prior, self.visible[vertex], floor, held)


def descend(
    update: Update, prior: State, last: np.ndarray, cloud: Cloud, body_vertices: np.ndarray | None, contact: BodyContact | None,
    physics_lambda: float, model: Model, config: Config,
) -> Update:  # fmt: skip
    """The estimate before the first pass over all vertices.

    By the paper's association, which has no normals, nothing is done.

    Args:
        update: as it begins.
        prior: the prediction.
        last: (V, 3) posterior of the last frame, metres.
        cloud: the preprocessed points.
        body_vertices: (B, 3) metres, what may hide the garment from a sensor, or None.
        contact: the body, or None.
        physics_lambda: of stage G.
        model, config: of the tracker.
    """
    rule, planar = config.pyramid, isinstance(config.associate, PlaneAssociation)
    if cloud.empty or not planar or rule.iterations == 0 or model.coarser is None:
        return update
    floor = None if contact is None else contact.planes(update.position, config.physics)
    visible = update.measurement.visible
    if visible is None:
        visible = associate.visible(update.position, cloud, body_vertices, model, config.associate)
    whole = Level(update.position, last, update.rest.rotation, prior, visible, floor, update.held)
    shared = Shared(cloud, physics_lambda, _coarsened(config, rule))
    position, passes = _from_below(whole, model.coarser, 1.0, shared)
    return update._replace(position=position, passes=passes)


def _coarsened(config: Config, rule: Pyramid) -> Config:
    """The physics of what edges cannot show that are longer than wrinkles: cloth that shrinks and stretches by them."""
    physics = dataclasses.replace(
        config.physics,
        stretch=rule.strain * config.physics.stretch,
        shear=rule.strain * config.physics.shear,
        rest_rigidity=rule.rest * config.physics.rest_rigidity,
        motion_rigidity=rule.motion * config.physics.motion_rigidity,
    )
    return dataclasses.replace(config, physics=physics)


def _from_below(whole: Level, coarser: Coarser, stands_for: float, shared: Shared) -> tuple[np.ndarray, int]:
    """(V, 3) position of a level after the passes of the coarser ones, and their number.

    Args:
        whole: the level.
        coarser: the next coarser one.
        stands_for: vertices of the garment that one of the level's stands for.
        shared: what is measured.
    """
    level = whole.thinned(coarser.vertex)
    stands_for *= len(whole.position) / len(coarser.vertex)
    start, done = level.position, 0
    if coarser.model.coarser is not None:
        start, done = _from_below(level, coarser.model.coarser, stands_for, shared)
    found, passes = _passes(level, start, done, coarser.model, stands_for, shared)
    moved = np.empty_like(whole.position)
    kernels.interpolate(whole.position, found - level.position, coarser.corner, coarser.share, moved)
    return moved, done + passes


def _passes(
    level: Level, start: np.ndarray, done: int, model: Model, stands_for: float, shared: Shared
) -> tuple[np.ndarray, int]:
    """(W, 3) position of a level after its own passes from ``start``, and their number; ``done`` passes were coarser."""
    cloud, physics_lambda, config = shared
    rule, prior = config.pyramid, level.prior
    held = None if level.held is None else level.held._replace(weight=stands_for * level.held.weight)
    update = fuse.begin(prior, level.last, level.rotation, physics_lambda, model, config, held)
    update = update._replace(position=start, information=stands_for * update.information)
    for gate in associate.gates(cloud, config.associate, 1 if done else 0):
        measurement = associate.associate(
            update.position, update.measurement, cloud, None, model, gate, config.associate, visible=level.visible
        )
        weight = robust.weigh(measurement, update.position, prior.P_pp, prior.R, config.robust)
        forces = energies.linearize(update.position, update.energies, model, None, physics_lambda, config.physics)
        forces = forces._replace(collision=_pushed_out(update.position, level.floor, model))
        update = fuse.fuse(
            update, prior, _denser(measurement, stands_for), stands_for * weight, prior.R, forces, gate, model, config
        )
        if update.rejected:
            return start, update.passes
        step = np.square(update.position - update.before[0]).sum() / len(start)
        if update.passes == 1 and step < rule.tolerance**2:
            return start, 1  # good already; what the coarser shape would have otherwise must not add up over the frames
        if update.passes >= rule.iterations or step < rule.tolerance**2:
            break
    return update.position, update.passes


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

"""Gravity: the weight of cloth, and the acceleration of a body under it, as a force of the MAP problem (not in the paper).

Where the track starts, elastic forces and what carries the garment balance the weight. The strain there that is not at rest still
draws, up from the hems and down from the top, and so much of the weight draws against it, see :func:`at_start`. On a body, from
there on,

- cloth that has turned by R since then hangs another way: what is new of its weight is g - R g;
- a body that accelerates leaves its cloth behind: prediction rides on the body, and in its frame -a is added;
- contact pushes cloth off the body and never back, so errors of many frames would lift it off the shoulders that carry it. Cloth
  close to a body that carries the garment is pressed down by all of its weight, g.

A body carries what lies on surface that faces upward, as on shoulders. A waistband holds trousers by friction, which the body
anchor stands for.
"""

from __future__ import annotations

import numpy as np

from ddakf.kernels import fuse as fusion
from ddakf.kernels import strain as kernels
from ddakf.kernels.normals import vertex_normals
from ddakf.kernels.strain import StrainConstants
from ddakf.types import Problem, Setup

GRAVITY = 9.81  # m/s^2
SHORTEST = 1.0 / 60.0  # s: over less, a change of the body's velocity is that of the scatter of its poses
MOST = 2.0  # times the weight, that strain of the start balances; noise of a start strains it more
TOP = 0.2  # m of cloth below the garment's top, within which it is carried
LYING = 0.1  # cosine squared of its normals to the vertical, that cloth has at least there: a waistband carries too


def at_start(position: np.ndarray, strain: StrainConstants, setup: Setup) -> np.ndarray:
    """(V,) 1/m: upward forces on a garment that starts at (V, 3) ``position``, metres, which together are none.

    Cloth draws down by the share of its weight which strain that is not at rest balances: in a small vertical stretch, stretch
    and shear do as much work as that share of the weight, held at the highest vertex. Near the top, where it lies or is held,
    what carries it draws up. A garment in the shape of its template has no strain, and needs none.

    Args:
        position: of the start.
        strain: of its faces, a share of which is at rest.
        setup: constants of the tracker.
    """
    model, config, up = setup.model, setup.config.physics, setup.config.start.to_y_up[1]
    share = model.vertex_share / model.vertex_share.sum()
    rows, force, blocks = np.zeros((len(share), 4)), np.zeros((len(share), 4)), np.zeros((len(model.mesh.edges), 12), np.float32)
    rows[:, :3] = position
    kernels.add_strain(rows, strain, config.in_plane, config.in_plane, config.strain_scale**2, blocks, force)
    height, weight, normal = position @ up, config.weight * model.area * share, np.empty((len(share), 3))
    below = height.max() - height
    hung = weight @ below
    if hung <= 0.0:
        return np.zeros(len(share))
    balanced = min(max(float(force[:, :3] @ up @ below) / hung, 0.0), MOST)
    vertex_normals(np.ascontiguousarray(position), model.faces, normal)
    carrying = share * (np.maximum(normal @ up, 0.0) ** 2 + LYING) * np.exp(-model.hanging / TOP)
    return balanced * weight.sum() * (carrying / carrying.sum() - share)


def force(problem: Problem, rotation: np.ndarray) -> np.ndarray | None:
    """(V, 3) force on each vertex of a garment on its body, 1/m; None without the body's pose.

    Args:
        problem: the frame, with the pseudo-measurements of the body anchor.
        rotation: (V, 3, 3) of the one-rings, from the shape in which the cloth is at rest.
    """
    model, config, up = problem.model, problem.config.physics, problem.config.start.to_y_up[1]
    if problem.body is None or config.weight == 0:
        return None
    start_force = 0.0 if problem.resting is None else problem.resting.upward[:, None] * up
    if problem.anchored is None:  # the body does not hold the garment yet, which would fall
        return None if problem.resting is None else start_force
    direction = (rotation @ up) * (1.0 - _pressed(problem, up))[:, None] - up - _left_behind(problem)
    return config.weight * model.area / len(direction) * model.vertex_share[:, None] * direction + start_force


def add_to_seen(problem: Problem, observed: np.ndarray, force: np.ndarray) -> None:
    """Adds the forces of the start, without a body, on the vertices that (V,) are ``observed``.

    Measurements hold what they see, and nothing else would hold the rest. Where nothing is known of the start, there are none.

    Args:
        problem: the frame.
        observed: bool.
        force: (V, 4) 1/m, padded, in and out.
    """
    if problem.resting is not None and problem.config.physics.weight > 0:
        up = problem.config.start.to_y_up[1]
        fusion.add_upward(problem.resting.upward, problem.model.vertex_share, observed, up, force)


def _pressed(problem: Problem, up: np.ndarray) -> np.ndarray:
    """(V,) in [0, 1]: share of its weight with which cloth is pressed onto the body, by its contacts in the last frame."""
    contacts, config = problem.last.body.contacts, problem.config.physics
    if contacts is None:
        return np.zeros(len(problem.model.vertex_share))
    face, normal, distance = contacts.closest.face, contacts.closest.normal, np.maximum(contacts.closest.distance, 0.0)
    near = np.where(face < 0, 0.0, 1.0 / (1.0 + np.square(distance / config.pressed_within)))
    carrying = float((near * np.square(np.maximum(normal @ up, 0.0))).mean())
    return min(1.0, (carrying / config.carrying_share) ** 2) * near


def _left_behind(problem: Problem) -> np.ndarray | float:
    """(V, 3) times gravity: the share of the body's acceleration that its cloth does not take part in at once."""
    before, config = problem.last.body.velocity, problem.config.physics
    if problem.carried is None or before is None:
        return 0.0
    time = max(problem.dt, SHORTEST)
    acceleration = (problem.dt / time) * (problem.carried / problem.dt - before) / (GRAVITY * time)
    size = np.sqrt(np.einsum("va,va->v", acceleration, acceleration))
    return config.inertia * np.minimum(1.0, config.strongest_inertia / np.maximum(size, 1e-9))[:, None] * acceleration

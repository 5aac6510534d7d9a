"""Weight of cloth on a body: gravity, and the body's acceleration, as a force of the MAP problem (not in the paper).

Where the track starts, elastic forces and the body balance the weight. From there on

- cloth that has turned by R since then hangs another way: what is new of its weight is g - R g;
- a body that accelerates leaves its cloth behind: prediction rides on the body, and in its frame -a is added;
- contact pushes cloth off the body and never back, so errors of many frames would lift it off the shoulders that carry it. Cloth
  close to a body that carries the garment is pressed down by all of its weight, g.

A body carries what lies on surface that faces upward, as on shoulders. A waistband holds trousers by friction, which the body
anchor stands for.
"""

from __future__ import annotations

import numpy as np

from ddakf.types import Problem

GRAVITY = 9.81  # m/s^2


def force(problem: Problem, rotation: np.ndarray) -> np.ndarray | None:
    """(V, 3) force on each vertex, 1/m; None where the body does not hold the garment, which would then fall.

    Args:
        problem: the frame, with the pseudo-measurements of the body anchor.
        rotation: (V, 3, 3) of the one-rings, from the shape in which the cloth is at rest.
    """
    model, config, up = problem.model, problem.config.physics, problem.config.start.to_y_up[1]
    if problem.anchored is None or config.weight == 0:
        return None
    direction = (rotation @ up) * (1.0 - _pressed(problem, up))[:, None] - up - _left_behind(problem)
    return config.weight * model.area / len(direction) * model.vertex_share[:, None] * direction


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
    acceleration = (problem.carried / problem.dt - before) / (GRAVITY * problem.dt)
    size = np.sqrt(np.einsum("va,va->v", acceleration, acceleration))
    return config.inertia * np.minimum(1.0, config.strongest_inertia / np.maximum(size, 1e-9))[:, None] * acceleration

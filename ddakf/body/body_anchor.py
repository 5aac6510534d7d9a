"""Body anchor: the garment's place on the body as a pseudo-measurement of its vertices.

Prediction rides on the body from frame to frame, and unseen cloth adds up the errors of all frames. Its place on the body since
the start does not. The variance of this pseudo-measurement is learned where the garment is seen, as stage D learns R: a shirt
that fits tightly is held, a skirt that swings is not.

A seen vertex is known along its normal, but planes do not tell where it is along the cloth: a skirt turns about the hips
unnoticed. So the body also holds what is seen, across the normal alone, and the less the better the garment's shape tells where
it is: sleeves keep a shirt from turning. Cloth that is held along itself seems to stay where it is held. What the cloud shows
of its deviation is along the normal: so cloth that swings away from the body is held less along itself as well.
"""

from __future__ import annotations

from math import exp

import numpy as np

from ddakf.body import contact
from ddakf.config import ConstantVelocity
from ddakf.garment.slippage import least_normal_share
from ddakf.kernels.normals import vertex_normals
from ddakf.types import BodyAnchor, Bound, Model, Planes, Problem, Setup

UNKNOWN = 1e4  # m^2: variance of what is not measured


def start(setup: Setup, pose: np.ndarray, position: np.ndarray) -> BodyAnchor:
    """The anchor of a garment at (V, 3) ``position`` on the body in a (B, 3) ``pose``, metres; nothing is learned yet."""
    n = len(setup.model.likeness)
    bound = contact.bind(setup.body, pose, position, setup.config.predict.anchor_reach)
    slippage, guess = least_normal_share(position, setup.model.faces), _first_guess(setup, bound)
    return BodyAnchor(bound, np.zeros(n), np.zeros((n, 2)), np.zeros(len(position), bool), slippage, guess)


def _first_guess(setup: Setup, bound: Bound) -> np.ndarray:
    """(L, 2) m^2 of the deviations in a patch, along the normal and along either tangent, that grow with its clearance."""
    patch, config, (face, distance) = setup.model.patch, setup.config.predict, (bound.contact.face, bound.contact.distance)
    clearance = np.where(face < 0, config.anchor_reach, np.clip(distance, 0.0, config.anchor_reach))
    mean = np.bincount(patch, clearance) / np.bincount(patch)
    on_body = np.array([config.worn_normal_sd, config.worn_tangential_sd])
    return np.square(np.minimum(on_body + config.worn_slope * mean[:, None], config.worn_sd))


def enabled(config: ConstantVelocity) -> bool:
    """Whether the body holds unseen vertices."""
    return config.carry_reach > 0 and config.worn_memory > 0


def measure(problem: Problem) -> Problem:
    """The problem with the pseudo-measurements of the vertices: in all directions, or across the normal where one was measured.

    There are none where the pose of the body is not known, and while a relocalized garment settles. The deviations of a patch
    count as a few independent ones, those along the normal and across it each with its own variance. A patch of which nothing
    was seen has that of the patches around it.
    """
    anchor, body, model, config = problem.last.anchor, problem.body, problem.model, problem.config.predict
    if anchor is None or body is None or problem.health.settling:
        return problem
    target = contact.follow(anchor.bound, body, config.anchor_reach)
    normal = np.empty_like(target)
    vertex_normals(target, model.faces, normal)
    size = len(target) / len(model.likeness)
    along, across = size * _variance(anchor, model, config)[model.patch].T
    hold = min(1.0, (config.anchor_slippage / max(anchor.slippage, 1e-6)) ** config.anchor_slippage_power)
    seen_across = (along + across + size * config.anchor_seen_sd**2) / (config.anchor_seen_samples * hold)
    planes = Planes(
        target=target,
        normal=normal,
        weight=np.where(anchor.bound.contact.face < 0, 0.0, 1.0),
        variance=np.where(anchor.measured, UNKNOWN, along / config.anchor_normal_samples),
        tangential=np.where(anchor.measured, seen_across, across / config.anchor_tangential_samples),
    )
    return problem._replace(anchored=planes)


def slack(problem: Problem) -> np.ndarray | None:
    """(L,) metres: standard deviation of a patch's place on the body; None without pseudo-measurements."""
    if problem.anchored is None:
        return None
    along, across = _variance(problem.last.anchor, problem.model, problem.config.predict).T
    return np.sqrt(along + 2.0 * across)


def _variance(anchor: BodyAnchor, model: Model, config: ConstantVelocity) -> np.ndarray:
    """(L, 2) m^2 of the deviations in a patch, along the normal and along either tangent."""
    near = model.likeness @ np.column_stack([anchor.squares, anchor.seen])
    first = config.anchor_first_share
    return np.maximum((near[:, :2] + first * anchor.guess) / (near[:, 2:] + first), config.anchor_least_sd**2)


def learned(problem: Problem, position: np.ndarray, measured: np.ndarray) -> BodyAnchor | None:
    """The anchor after a frame. A relocalized garment gets a new one once it has settled.

    Args:
        problem: the frame.
        position: (V, 3) the posterior, metres.
        measured: (V,) bool.
    """
    anchor, model, config, planes = problem.last.anchor, problem.model, problem.config.predict, problem.anchored
    if problem.last.body is None or problem.health.settling > 0 or not enabled(config):
        return None
    if anchor is None:
        body = problem.body
        return None if body is None else start(Setup(model, body.model, problem.config), body.vertices, position)
    if planes is None:
        return anchor
    n, used = len(anchor.seen), measured & (anchor.bound.contact.face >= 0)
    patch, deviation = model.patch[used], (position - planes.target)[used]
    along = np.square(np.einsum("va,va->v", deviation, planes.normal[used]))
    across = 0.5 * (np.einsum("va,va->v", deviation, deviation) - along)
    size = np.bincount(model.patch, minlength=n)
    sums = np.column_stack([np.bincount(patch, weights, n) for weights in (along, across, None)]) / size[:, None]
    old = exp(-problem.dt / config.worn_memory)
    return anchor._replace(
        seen=old * anchor.seen + (1.0 - old) * sums[:, 2],
        squares=old * anchor.squares + (1.0 - old) * sums[:, :2],
        measured=measured,
    )

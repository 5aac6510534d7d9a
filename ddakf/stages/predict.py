"""Stage A, prediction (paper, section 2.2): constant velocity per vertex, riding on the body where one is given.

Damping keeps unseen vertices from running on. A garment without a body also turns and travels as a whole with its wearer, and a
prediction that lags behind a turn is not corrected where planes slide along the cloth. So damping spares rigid motion.
"""

from __future__ import annotations

from math import expm1
from typing import NamedTuple

import numpy as np

from ddakf.body import body_anchor, contact
from ddakf.config import ConstantAcceleration, ConstantVelocity
from ddakf.kernels import predict as kernels
from ddakf.kernels.predict import CovarianceBlocks
from ddakf.physics import adaptive_stiffness
from ddakf.types import FrameInput, Problem, Setup, State, Track


def begin(setup: Setup, last: Track, frame: FrameInput) -> Problem:
    """The problem of a frame: the body in its pose, the configuration as stiff as the garment, and the prediction.

    Args:
        setup: constants of the tracker.
        last: after the last frame.
        frame: checked.
    """
    dt = setup.config.start.first_step if last.time is None else frame.timestamp - last.time
    config = adaptive_stiffness.adapted(last.strain2, setup.config)
    state, body, carried = last.state, None, None
    if last.time is not None and last.health.spacing == 0.0:
        state = _of_second_frame(state, dt, setup.config.start.first_step)
    if last.time is None and frame.body_vertices is not None:
        last = body_anchor.placed(setup, last, frame.body_vertices)
    if setup.body is not None:
        vertices = contact.moved_on(setup.body, last.body, dt) if frame.body_vertices is None else frame.body_vertices
        if vertices is not None:
            body = contact.posed(setup.body, last.body, vertices)
        state, carried = contact.carry(setup.body, last.body, state, body, dt, config.predict.friction)
    prior = predict(state, dt, carried, config.predict, seen=not last.health.unplaced)
    return Problem(
        setup.model, config, last, frame, dt, state, carried, body, prior, state.position, last.rotation, last.health,
        reference=setup.reference, resting=last.resting,
    )  # fmt: skip


def predict(
    state: State, dt: float, carried: np.ndarray | None, config: ConstantVelocity | ConstantAcceleration, *, seen: bool = True
) -> State:
    """The prior of the next frame.

    x = F x, P = F P F' + Q with F = [[I, s I], [0, g I]], g = exp(-damping dt), s = (1 - g) / damping, and Q of accelerations
    that each last ``acceleration_time``: of one in a short step, of white ones in a long step. One acceleration over a long step
    would set the velocity to twice the innovation over dt, which makes it ring. A gap longer than ``longest_step`` moves the mean
    no further than that step, while P grows with all of it. A known acceleration is an input: it moves the mean and leaves P as
    it is. Without a body the rigid part of the velocities turns the garment, and is damped less, the larger its share of them.

    Args:
        state: posterior of the last frame.
        dt: seconds since.
        carried: (V, 3) metres, displacement of each vertex with the body; the velocity is then the residual one.
        config: damping and process noise, and how long an acceleration lasts.
        seen: the last frame showed where the garment is; if not, rigid motion is damped as all motion.
    """
    g = float(np.exp(-config.damping * dt))
    step = min(dt, config.longest_step)
    travel = _travel(config.damping, step)
    if carried is None and seen and config.damping > 0:
        position, velocity = _rigidly_moved(state.position, state.velocity, dt, step, config.damping)
    else:
        position, velocity = state.position + travel * state.velocity, g * state.velocity
    acceleration = state.acceleration
    if isinstance(config, ConstantAcceleration):
        lasting = min(travel, config.memory)
        gain = config.share * lasting * state.acceleration
        position, velocity = position + (travel - lasting / 2) * gain, velocity + gain
        acceleration = _smoothed(state.acceleration, (velocity - state.velocity) / dt, dt, config)
    if carried is not None:
        position = position + carried
    q = config.acceleration**2
    # Q of n accelerations one after the other; beyond the longest step P_pp alone grows, in proportion to the gap
    part = min(step, config.acceleration_time)
    n = step / part
    noise = q * part**4 * (n**3 / 3 - n / 12) * max(dt, step) / step, q * part**3 * n**2 / 2, q * part**2 * n
    P_pp, P_pu, P_uu = (np.empty(state.P_pp.shape) for _ in range(3))
    last = CovarianceBlocks(state.P_pp, state.P_pu, state.P_uu)
    kernels.propagate(last, travel, g, noise, CovarianceBlocks(P_pp, P_pu, P_uu))
    return State(position, velocity, P_pp, P_pu, P_uu, state.R, acceleration)


def with_given_velocity(problem: Problem, state: State) -> State:
    """The posterior of a frame, with the predicted velocity in a first frame after a start with velocities.

    Nobody knows how long before it the start was, so that it cannot correct a velocity.
    """
    given = problem.last.time is None and problem.last.health.spacing > 0.0
    return state._replace(velocity=problem.prior.velocity) if given else state


def _of_second_frame(state: State, dt: float, assumed: float) -> State:
    """The state after the first frame, before which as much time had passed as passes now; ``assumed`` were fewer seconds."""
    return state._replace(velocity=min(1.0, assumed / dt) * state.velocity)


def _travel(damping: float, step: float) -> float:
    """Seconds for which a velocity would travel as far, undamped, as it does damped in ``step`` seconds."""
    return step if damping == 0 else -expm1(-damping * step) / damping


def _rigidly_moved(
    position: np.ndarray, velocity: np.ndarray, dt: float, step: float, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """Positions after ``step`` and velocities after ``dt`` seconds, (V, 3) each, of vertices that turn with their rigid motion.

    The rigid motion is the least-squares one, of all vertices alike. With r its share of sum |u|^2 it is damped by (1 - r)
    ``damping``, what remains of u by ``damping``.
    """
    motion, share = _rigid_motion(position, velocity)
    lasting = damping * (1.0 - share)
    travel = _travel(lasting, step)
    moved, kept, rotation = np.empty(position.shape), np.empty(position.shape), np.empty((3, 3))
    kernels.rotation_matrix(motion[2], travel, rotation)
    kernels.move_rigidly(
        position, velocity, motion, rotation, (travel, float(np.exp(-lasting * dt))),
        (_travel(damping, step), float(np.exp(-damping * dt))), moved, kept,
    )  # fmt: skip
    return moved, kept


def _rigid_motion(position: np.ndarray, velocity: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], float]:
    """The least-squares rigid motion, and its share of sum |u|^2.

    The motion is its centre (m), the centre's velocity (m/s), and the angular velocity (rad/s), (3,) each.
    """
    center, mean, momentum, turning, inertia = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    kernels.means(position, velocity, center, mean)
    square = kernels.moments(position, velocity, center, inertia, momentum)
    rigid = len(position) * float(mean @ mean) + kernels.angular_velocity(inertia, momentum, turning)
    return (center, mean, turning), min(1.0, rigid / max(square, 1e-30))


class Ahead(NamedTuple):
    """The garment some time after a frame."""

    position: np.ndarray  # (V, 3) m
    velocity: np.ndarray  # (V, 3) m/s, the body's motion included
    growth: np.ndarray  # (V, 3, 3) or (3, 3) m^2, by which the position's covariance has grown


def ahead(track: Track, seconds: float, config: ConstantVelocity | ConstantAcceleration) -> Ahead:
    """The garment moved on in time.

    The mean goes where :func:`predict` takes it with all velocity damped, which a client computes for itself from a result. The
    covariance grows by what predictions of this garment have missed lately, and of its body: as much a frame ahead, further with
    the cube of the time, as under white acceleration. Before there are any, by as much as P does.

    Args:
        track: after a frame.
        seconds: since that frame.
        config: of stage A.
    """
    state, missed, dt = track.state, track.drift.missed, track.health.spacing or seconds
    carrying, step = None if track.body is None else track.body.velocity, min(seconds, config.longest_step)
    prior = predict(state, seconds, None if carrying is None else step * carrying, config, seen=False)
    if missed.any():
        grown = seconds**2 * max(seconds / dt, 1.0) * missed
    else:
        grown = prior.P_pp - state.P_pp
    return Ahead(prior.position, prior.velocity if carrying is None else prior.velocity + carrying, grown)


def learn_acceleration(problem: Problem, posterior: State, measured: np.ndarray) -> State:
    """The posterior with the acceleration that its velocities show; with constant velocity as it came.

    The prior's acceleration is smoothed with the velocities as they were predicted. Here follows what the frame corrected of
    them. A frame without measurements shows no acceleration, and what there was fades.

    Args:
        problem: the frame.
        posterior: of this frame.
        measured: (V,) bool.
    """
    prior, dt, config = problem.prior, problem.dt, problem.config.predict
    if not isinstance(config, ConstantAcceleration):
        return posterior
    if not measured.any():
        return posterior._replace(acceleration=_smoothed(prior.acceleration, 0.0, dt, config))
    old = np.exp(-dt / config.memory)
    return posterior._replace(acceleration=prior.acceleration + (1.0 - old) * (posterior.velocity - prior.velocity) / dt)


def _smoothed(acceleration: np.ndarray, new: np.ndarray | float, dt: float, config: ConstantAcceleration) -> np.ndarray:
    old = np.exp(-dt / config.memory)
    return old * acceleration + (1.0 - old) * new

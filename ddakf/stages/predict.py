"""Stage A, prediction (paper, section 2.2): constant velocity per vertex, riding on the body where one is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ddakf.body import contact
from ddakf.config import ConstantAcceleration, ConstantVelocity
from ddakf.kernels import predict as kernels
from ddakf.kernels.predict import CovarianceBlocks
from ddakf.physics import adaptive_stiffness
from ddakf.types import FrameInput, FrameResult, Problem, Setup, State, Track, variances


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
    if setup.body is not None:
        if frame.body_vertices is not None:
            body = contact.posed(setup.body, last.body, frame.body_vertices)
        state, carried = contact.carry(setup.body, last.body, state, body)
    prior = predict(state, dt, carried, config.predict)
    return Problem(
        setup.model, config, last, frame, dt, state, carried, body, prior, state.position, last.rotation, last.health
    )


def predict(state: State, dt: float, carried: np.ndarray | None, config: ConstantVelocity | ConstantAcceleration) -> State:
    """The prior of the next frame.

    x = F x, P = F P F' + Q with F = [[I, dt I], [0, g I]], g = exp(-damping dt), and Q of white acceleration. A gap longer
    than ``longest_step`` moves the mean no further than that step, while P grows with all of it. An acceleration enters as a
    known input: it moves the mean and leaves P as it is.

    Args:
        state: posterior of the last frame.
        dt: seconds since.
        carried: (V, 3) metres, displacement of each vertex with the body; the velocity is then the residual one.
        config: damping and process noise, and how long an acceleration lasts.
    """
    g = float(np.exp(-config.damping * dt))
    step = min(dt, config.longest_step)
    travel = step if config.damping == 0 else (1.0 - np.exp(-config.damping * step)) / config.damping
    position, velocity, acceleration = state.position + travel * state.velocity, g * state.velocity, state.acceleration
    if isinstance(config, ConstantAcceleration):
        lasting = min(travel, config.memory)
        gain = config.share * lasting * state.acceleration
        position, velocity = position + (travel - lasting / 2) * gain, velocity + gain
        acceleration = _smoothed(state.acceleration, (velocity - state.velocity) / dt, dt, config)
    if carried is not None:
        position = position + carried
    q = config.acceleration**2
    # white acceleration over dt, saturating at the longest step so that a long gap stays bounded
    noise = q * step**3 * max(dt, step) / 4, q * step**3 / 2, q * step**2
    P_pp, P_pu, P_uu = (np.empty(state.P_pp.shape) for _ in range(3))
    last = CovarianceBlocks(state.P_pp, state.P_pu, state.P_uu)
    kernels.propagate(last, travel, g, noise, CovarianceBlocks(P_pp, P_pu, P_uu))
    return State(position, velocity, P_pp, P_pu, P_uu, state.R, acceleration)


def ahead(result: FrameResult, track: Track, seconds: float, config: ConstantVelocity | ConstantAcceleration) -> FrameResult:
    """A frame's result moved on in time.

    The mean goes where :func:`predict` takes it. The covariance grows by what predictions of this garment have missed lately:
    a frame ahead by the innovations, further with the cube of the time, as under white acceleration. Before there are any, by as
    much as P does.

    Args:
        result: of the frame.
        track: after the same frame.
        seconds: since the frame.
        config: of stage A.
    """
    state, speed2, dt = track.state, track.drift.speed2, track.health.spacing
    carrying = None if track.body is None else track.body.velocity
    if seconds == 0.0:
        return result
    prior = predict(state, seconds, None if carrying is None else seconds * carrying, config)
    if speed2 > 0.0:
        grown = speed2 * seconds**2 * max(seconds / dt, 1.0) / 3.0 * np.eye(3)
    else:
        grown = prior.P_pp - state.P_pp
    covariance = result.covariance + grown
    return replace(
        result,
        vertices=prior.position,
        velocities=prior.velocity if carrying is None else prior.velocity + carrying,
        covariance=covariance,
        sigma=np.sqrt(variances(covariance)),
    )


def learned(problem: Problem, posterior: State, measured: np.ndarray) -> State:
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

"""Stage A, prediction (paper, section 2.2): constant velocity per vertex, riding on the body where one is given."""

from __future__ import annotations

import numpy as np

from ddakf.config import ConstantVelocity
from ddakf.physics import proximity
from ddakf.types import State


def predict(state: State, dt: float, carried: np.ndarray | None, config: ConstantVelocity) -> State:
    """The prior of the next frame.

    x = F x, P = F P F' + Q with F = [[I, dt I], [0, g I]], g = exp(-damping dt), and Q of white acceleration. A gap longer
    than ``longest_step`` moves the mean no further than that step, while P grows with all of it.

    Args:
        state: posterior of the last frame.
        dt: seconds since.
        carried: (V, 3) metres, displacement of each vertex with the body; the velocity is then the residual one.
        config: damping and process noise.
    """
    g = float(np.exp(-config.damping * dt))
    step = min(dt, config.longest_step)
    travel = step if config.damping == 0 else (1.0 - np.exp(-config.damping * step)) / config.damping
    position = state.position + travel * state.velocity
    if carried is not None:
        position = position + carried
    q = config.acceleration**2
    P_uu = state.P_uu
    cross = state.P_pu + travel * P_uu
    P_pp = state.P_pp + travel * (state.P_pu + state.P_pu.transpose(0, 2, 1)) + travel**2 * P_uu
    eye = np.eye(3)
    # white acceleration over dt, saturating at the longest step so that a long gap stays bounded
    return State(
        position=position,
        velocity=g * state.velocity,
        P_pp=P_pp + q * step**3 * max(dt, step) / 4 * eye,
        P_pu=g * cross + q * step**3 / 2 * eye,
        P_uu=g * g * P_uu + q * step**2 * eye,
        R=state.R,
    )


def carry(
    body: proximity.Body,
    last: np.ndarray,
    now: np.ndarray,
    position: np.ndarray,
    contact: proximity.Contact,
    config: ConstantVelocity,
) -> np.ndarray:
    """(V, 3) metres: how the body's motion from ``last`` to ``now`` displaces the vertices at ``position``."""
    return proximity.surface_motion(body, last, now, position, contact, config.carry_reach).position - position

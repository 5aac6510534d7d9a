"""What flows between the stages, and what a step returns. V vertices, N points; metres, seconds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

TrackerState = Literal["initializing", "tracking", "recovering", "lost"]


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The garment after one frame.

    Attributes:
        vertices: (V, 3) positions, metres.
        velocities: (V, 3) metres per second.
        covariance: (V, 3, 3) position covariance, square metres.
        sigma: (V,) sqrt(trace(covariance) / 3), metres.
        vertex_reliability: (V,) in [0, 1].
        observed: (V,) bool, a measurement passed the gate in this frame.
        reliability: the frame's score in [0, 1]; high means low error.
        paper_score: s_k of the paper, section 2.6.
        coverage: share of the vertices that were observed.
        state: what the tracker is doing.
        timings: seconds per stage, by the stage's name, and "total".
    """

    vertices: np.ndarray
    velocities: np.ndarray
    covariance: np.ndarray
    sigma: np.ndarray
    vertex_reliability: np.ndarray
    observed: np.ndarray
    reliability: float
    paper_score: float
    coverage: float
    state: TrackerState
    timings: dict[str, float] = field(default_factory=dict)


class State(NamedTuple):
    """Posterior (or, after stage A, prior) of every vertex: mean and the blocks of the 6x6 covariance P_i, and R_i."""

    position: np.ndarray  # (V, 3) p, m
    velocity: np.ndarray  # (V, 3) u, m/s
    P_pp: np.ndarray  # (V, 3, 3) m^2
    P_pu: np.ndarray  # (V, 3, 3) m^2/s
    P_uu: np.ndarray  # (V, 3, 3) m^2/s^2
    R: np.ndarray  # (V, 3, 3) measurement covariance, m^2
    acceleration: np.ndarray  # (V, 3) m/s^2, smoothed; zero with constant velocity

    @classmethod
    def at(cls, position: np.ndarray, velocity: np.ndarray, sd: float, speed_sd: float, noise_sd: float) -> State:
        """A start, not accelerated: mean (V, 3) each, and the same standard deviations, in m, m/s and m, for every vertex."""
        eye = np.broadcast_to(np.eye(3), (len(position), 3, 3))
        P_pu, acceleration = np.zeros(eye.shape), np.zeros(position.shape)
        return cls(position, velocity, sd**2 * eye, P_pu, speed_sd**2 * eye, noise_sd**2 * eye, acceleration)

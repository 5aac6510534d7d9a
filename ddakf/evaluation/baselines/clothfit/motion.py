"""Recent motion of the carried places: velocity, acceleration, and damped pendulums that hang on them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SWINGS = ((0.6, 0.3), (1.2, 0.3), (2.5, 0.3), (5.0, 0.5))  # natural frequency in Hz, damping ratio below 1
MEAN = 0.1  # s: of the mean acceleration's exponential window


class Moved(NamedTuple):
    """Motion of Q places, in world axes."""

    elapsed: float  # s since the first frame
    velocity: np.ndarray  # (Q, 3) m/s
    acceleration: np.ndarray  # (Q, 3) m/s^2
    mean_acceleration: np.ndarray  # (Q, 3) m/s^2
    swings: list[np.ndarray]  # (Q, 3) m from the place, one for each of SWINGS


class Motion:
    """The memory of a garment's motion.

    A swing is a point on a damped spring whose other end is the carried place: r'' = -w^2 r - 2 z w r' - c'' with r its distance
    from the place c, solved exactly for a c that moves straight from frame to frame. Before the second frame there is no time
    step, and everything is at rest; its velocity counts as that of the start.
    """

    def __init__(self, places: np.ndarray):
        self._places = places
        self._began: float | None = None
        self._clock = 0.0
        self._velocity: np.ndarray | None = None
        self._mean = np.zeros_like(places)
        self._swings = [(np.zeros_like(places), np.zeros_like(places)) for _ in SWINGS]

    def step(self, places: np.ndarray, timestamp: float) -> Moved:
        """The carried places (Q, 3) of the next frame, metres, and its time in seconds."""
        acceleration = np.zeros_like(places)
        velocity = np.zeros_like(places)
        if self._began is None:
            self._began = timestamp
        elif timestamp > self._clock:
            dt = timestamp - self._clock
            velocity = (places - self._places) / dt
            change = velocity - (velocity if self._velocity is None else self._velocity)
            acceleration = change / dt
            fade = np.exp(-dt / MEAN)
            self._mean = fade * self._mean + (1 - fade) * acceleration
            self._swings = [swung(r, v - change, *spring, dt) for (r, v), spring in zip(self._swings, SWINGS, strict=True)]
            self._velocity = velocity
        self._places, self._clock = places, timestamp
        elapsed = timestamp - self._began
        return Moved(elapsed, velocity, acceleration, self._mean, [r for r, _ in self._swings])


def swung(r: np.ndarray, velocity: np.ndarray, frequency: float, damping: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and velocity after ``dt`` seconds of r'' + 2 z w r' + w^2 r = 0, w = 2 pi ``frequency``, z = ``damping``."""
    w = 2 * np.pi * frequency
    decay, ring = damping * w, w * np.sqrt(1 - damping**2)
    fade, c, s = np.exp(-decay * dt), np.cos(ring * dt), np.sin(ring * dt) / ring
    return fade * (r * (c + decay * s) + velocity * s), fade * (velocity * (c - decay * s) - r * w**2 * s)

"""Kalman filter per vertex: damped constant velocity, nearest points as measurements, nothing else.

State of a vertex: position p and velocity v. Prediction over a time dt: p <- p + v (1 - g) / damping, v <- g v with
g = exp(-damping dt), and the covariance of a white acceleration (Bar-Shalom, Li and Kirubarajan 2001, "Estimation with
applications to tracking and navigation", section 6.2). Measurement: the point c of the cloud nearest to the predicted position,
with the normal n of the points around it, z = c + noise of covariance R = r^2 n n' + t^2 (I - n n'). R is constant in the frame
of the surface: with t = r the textbook's isotropic one, with t much larger the point-to-plane distance (Chen and Medioni 1992).
Nothing beyond a gate. No neighbours, no physics, no adaptation.

A body carries the prediction, and the velocity is then relative to it. A vertex without a point is measured at its place on the
body, with a standard deviation that grows with its distance from the body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddakf.evaluation.baselines.body_support import support_of
from ddakf.evaluation.baselines.matching import LEAST_POINTS, MatchSettings, Scan, VertexNormals
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

FIRST_STEP = 1 / 30  # s between the start and the first frame
START_SD, START_SPEED_SD = 0.005, 0.3  # m, m/s


@dataclass(frozen=True)
class KalmanSettings(MatchSettings):
    """Numbers of the method, beside those of matching; the defaults are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        measurement_sd: r, metres.
        tangential_sd: t, metres.
        acceleration_density: square root of the spectral density of the white acceleration, m / s^1.5.
        damping: of the velocities, 1/s.
        held_sd: of the place on the body of a hidden vertex that touches it, metres.
    """

    measurement_sd: float = 0.1
    tangential_sd: float = 0.1
    acceleration_density: float = 0.3
    damping: float = 8.0
    held_sd: float = 0.02
    gate: float = 0.8


TUNED = KalmanSettings()


class KalmanFilter:
    """See the module."""

    def __init__(self, settings: KalmanSettings = TUNED):
        self.settings = settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        n = len(vertices)
        self._normals, self._time = VertexNormals(garment), None
        self._position = np.array(vertices, np.float64)
        self._velocity = np.zeros_like(self._position)
        self._covariance = np.tile(np.diag([START_SD**2] * 3 + [START_SPEED_SD**2] * 3), (n, 1, 1))
        self._support = support_of(body, self._position, 1.0)

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        self._position = self._support.begin(frame, self._position)
        self._predict(FIRST_STEP if self._time is None else frame.timestamp - self._time)
        self._time = frame.timestamp
        measured = np.zeros(len(self._position))
        if len(frame.points) >= LEAST_POINTS:
            found = Scan(frame, self.settings).match(self._position, self._normals(self._position))
            measured = found.weight
            self._update(measured > 0, found.points, self._noise(found.normals))
        held = self._support.held(measured)
        sd = self.settings.held_sd / np.sqrt(np.maximum(held, 1e-12))
        self._update(held > 0, self._support.place, np.square(sd)[:, None, None] * np.eye(3))
        return self._support.outside(self._position).copy()

    def _predict(self, dt: float) -> None:
        settings, axes = self.settings, np.eye(3)
        g = float(np.exp(-settings.damping * dt))
        travel = dt if settings.damping == 0 else (1 - g) / settings.damping
        transition = np.kron([[1, travel], [0, g]], axes)
        noise = np.kron(settings.acceleration_density**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), axes)
        self._position, self._velocity = self._position + travel * self._velocity, g * self._velocity
        self._covariance = transition @ self._covariance @ transition.T + noise

    def _noise(self, normals: np.ndarray) -> np.ndarray:
        """(V, 3, 3) R of points with these normals (V, 3)."""
        along, across = self.settings.measurement_sd**2, self.settings.tangential_sd**2
        return across * np.eye(3) + (along - across) * normals[:, :, None] * normals[:, None, :]

    def _update(self, chosen: np.ndarray, places: np.ndarray, noise: np.ndarray) -> None:
        """The Kalman update of the ``chosen`` vertices (V,) with measured places (V, 3) and their covariances (V, 3, 3)."""
        if not chosen.any():
            return
        prior = self._covariance[chosen]
        gain = prior[:, :, :3] @ np.linalg.inv(prior[:, :3, :3] + noise[chosen])
        correction = np.einsum("vab,vb->va", gain, places[chosen] - self._position[chosen])
        self._position[chosen] += correction[:, :3]
        self._velocity[chosen] += correction[:, 3:]
        posterior = prior - gain @ prior[:, :3]
        self._covariance[chosen] = 0.5 * (posterior + posterior.transpose(0, 2, 1))

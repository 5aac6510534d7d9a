"""Kalman filter per vertex: constant velocity, nearest points as measurements, nothing else.

State of a vertex: position p and velocity v. Prediction over a time dt: p <- p + v dt, with the covariance of a white
acceleration (Bar-Shalom, Li and Kirubarajan 2001, "Estimation with applications to tracking and navigation", section 6.2).
Measurement: the point of the cloud that is nearest to the predicted position, z = p + noise of covariance R = r^2 I, the same
in every frame and for every vertex; nothing beyond a gate. No neighbours, no surface, no physics, no adaptation. All noise is
isotropic, so that the three coordinates share one 2 x 2 covariance per vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ddakf.evaluation.baselines.matching import VertexNormals, facing
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

FIRST_STEP = 1 / 30  # s between the start and the first frame
START_SD, START_SPEED_SD = 0.005, 0.3  # m, m/s


@dataclass(frozen=True)
class KalmanSettings:
    """Numbers of the method; the defaults are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        measurement_sd: r, metres.
        acceleration_density: square root of the spectral density of the white acceleration, m / s^1.5.
        gate: metres.
        facing: vertices that face away from the sensor take no measurement.
    """

    measurement_sd: float = 0.3
    acceleration_density: float = 0.1
    gate: float = 0.15
    facing: bool = True


TUNED = KalmanSettings()


class KalmanFilter:
    """See the module. Uses no body."""

    def __init__(self, settings: KalmanSettings = TUNED):
        self.settings = settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        self._normals = VertexNormals(garment)
        self._position = np.array(vertices, np.float64)
        self._velocity = np.zeros_like(self._position)
        self._covariance = np.tile(np.diag([START_SD**2, START_SPEED_SD**2]), (len(vertices), 1, 1))
        self._time = None

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        self._predict(FIRST_STEP if self._time is None else frame.timestamp - self._time)
        self._time = frame.timestamp
        if len(frame.points):
            self._update(np.asarray(frame.points, np.float64), frame.sensor_origin)
        return self._position.copy()

    def _predict(self, dt: float) -> None:
        transition = np.array([[1, dt], [0, 1]])
        noise = self.settings.acceleration_density**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        self._position = self._position + dt * self._velocity
        self._covariance = transition @ self._covariance @ transition.T + noise

    def _update(self, points: np.ndarray, sensor_origin: np.ndarray | None) -> None:
        tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
        _, nearest = tree.query(self._position, distance_upper_bound=self.settings.gate)
        measured = nearest < tree.n
        if self.settings.facing:
            measured &= facing(self._position, self._normals(self._position), sensor_origin, np.where(measured, nearest, 0))
        prior = self._covariance[measured]
        gain = prior[:, :, 0] / (prior[:, 0, 0] + self.settings.measurement_sd**2)[:, None]
        innovation = points[nearest[measured]] - self._position[measured]
        self._position[measured] += gain[:, :1] * innovation
        self._velocity[measured] += gain[:, 1:] * innovation
        self._covariance[measured] = prior - gain[:, :, None] * prior[:, None, 0, :]

"""The Kalman filter per vertex is the textbook's."""

import numpy as np
import pytest

from ddakf.evaluation.baselines.kalman_filter import FIRST_STEP, START_SD, START_SPEED_SD, KalmanFilter, KalmanSettings
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

TRIANGLE = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])


def textbook(places, times, settings):
    """One vertex at the origin, 6 x 6, measured at each of the places or, where that is None, not at all."""
    x, now = np.zeros(6), times[0] - FIRST_STEP
    p = np.diag([START_SD**2] * 3 + [START_SPEED_SD**2] * 3)
    h, r = np.eye(3, 6), settings.measurement_sd**2 * np.eye(3)
    for place, time in zip(places, times, strict=True):
        dt, now = time - now, time
        f = np.eye(6) + dt * np.eye(6, k=3)
        q = settings.acceleration_density**2 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3))
        x, p = f @ x, f @ p @ f.T + q
        if place is not None:
            k = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
            x, p = x + k @ (place - h @ x), (np.eye(6) - k @ h) @ p
    return x[:3]


def test_a_vertex_is_filtered_as_in_the_textbook():
    rng, settings = np.random.default_rng(0), KalmanSettings(measurement_sd=0.02, acceleration_density=2.0, gate=0.2)
    times = [0.05, 0.08, 0.2, 0.23]
    places = [0.03 * rng.normal(size=3), 0.03 * rng.normal(size=3), None, 0.03 * rng.normal(size=3)]
    method = KalmanFilter(settings)
    method.start(TRIANGLE, TRIANGLE.vertices, None)
    for place, time in zip(places, times, strict=True):
        cloud = np.zeros((0, 3)) if place is None else place[None]
        estimate = method.step(CapturedFrame(0, time, cloud))
    assert estimate[0] == pytest.approx(textbook(places, times, settings))
    assert estimate[1:] == pytest.approx(TRIANGLE.vertices[1:])


def test_a_vertex_without_points_flies_on_at_its_speed():
    method = KalmanFilter(KalmanSettings(measurement_sd=0.001, acceleration_density=10.0, gate=0.2))
    method.start(TRIANGLE, TRIANGLE.vertices, None)
    for k in range(1, 40):
        method.step(CapturedFrame(0, k / 30, TRIANGLE.vertices + [0.01 * k, 0, 0]))
    estimate = method.step(CapturedFrame(0, 49 / 30, np.zeros((0, 3))))
    assert estimate - TRIANGLE.vertices == pytest.approx(np.tile([0.49, 0, 0], (3, 1)), abs=0.005)

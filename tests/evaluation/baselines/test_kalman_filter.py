"""The Kalman filter per vertex is the textbook's."""

from dataclasses import replace

import numpy as np
import pytest

from ddakf.evaluation.baselines.filters.kalman_filter import FIRST_STEP, START_SD, START_SPEED_SD, KalmanFilter, KalmanSettings
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from tests.evaluation.baselines.shapes import tube

ISOTROPIC = KalmanSettings(measurement_sd=0.02, tangential_sd=0.02, acceleration_density=2.0, damping=3.0, gate=0.5)


def textbook(places, times, settings):
    """One vertex at the origin, 6 x 6, measured at each of the places or, where that is None, not at all."""
    x, now = np.zeros(6), times[0] - FIRST_STEP
    p = np.diag([START_SD**2] * 3 + [START_SPEED_SD**2] * 3)
    h, r = np.eye(3, 6), settings.measurement_sd**2 * np.eye(3)
    for place, time in zip(places, times, strict=True):
        dt, now = time - now, time
        g = np.exp(-settings.damping * dt)
        f = np.kron([[1, (1 - g) / settings.damping], [0, g]], np.eye(3))
        q = settings.acceleration_density**2 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3))
        x, p = f @ x, f @ p @ f.T + q
        if place is not None:
            k = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
            x, p = x + k @ (place - h @ x), (np.eye(6) - k @ h) @ p
    return x[:3]


def shifted(garment, shifts, times, settings):
    """The estimate after clouds that are the garment's own vertices, each shifted; None for an empty cloud."""
    method = KalmanFilter(settings)
    method.start(garment, garment.vertices, None)
    for shift, time in zip(shifts, times, strict=True):
        cloud = np.zeros((0, 3)) if shift is None else garment.vertices + shift
        estimate = method.step(CapturedFrame(0, time, cloud))
    return estimate - garment.vertices


def test_vertices_are_filtered_as_in_the_textbook():
    garment, rng = tube(8, 4), np.random.default_rng(0)  # 15 cm between vertices: the nearest point is a vertex's own
    times = [0.05, 0.08, 0.2, 0.23]
    shifts = [0.01 * rng.normal(size=3), 0.01 * rng.normal(size=3), None, 0.01 * rng.normal(size=3)]
    found = shifted(garment, shifts, times, replace(ISOTROPIC, normal_cosine=-2.0))
    assert found == pytest.approx(np.tile(textbook(shifts, times, ISOTROPIC), (garment.n_vertices, 1)), abs=1e-9)


def test_a_vertex_without_points_coasts_to_a_stop():
    garment = tube(8, 4)
    settings = replace(ISOTROPIC, measurement_sd=0.001, tangential_sd=0.001, acceleration_density=10.0, normal_cosine=-2.0)
    shifts = [np.array([0.002 * k, 0, 0]) for k in range(1, 20)]
    times = [k / 30 for k in range(1, 20)]
    last = shifted(garment, shifts, times, settings)
    later = shifted(garment, [*shifts, None], [*times, times[-1] + 9.0], settings)
    speed = 0.002 * 30
    assert (later - last)[:, 0] == pytest.approx(speed / settings.damping, rel=0.1)


def test_points_say_nothing_along_the_surface_when_told_so():
    garment = tube(24, 14)
    free = replace(ISOTROPIC, tangential_sd=10.0)
    upward = shifted(garment, [np.array([0, 0.01, 0])], [0.05], free)  # along the tube's axis
    across = shifted(garment, [np.array([0, 0.01, 0])], [0.05], ISOTROPIC)
    inner = slice(30, 300)
    assert np.abs(upward[inner, 1]).mean() < 0.3 * across[inner, 1].mean()

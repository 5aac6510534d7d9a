"""A swaying tube, and what the tests of the tracker ask of every result."""

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.data import sample
from ddakf.evaluation.sensors import Sensor
from tests.stages.scenes import FPS, inner_body, rms, scan, tube

SAMPLE = sample()
SHIRT = Mesh(SAMPLE.template, SAMPLE.garment_faces)
WEARER = Mesh(SAMPLE.body_vertices[0], SAMPLE.body_faces)
TUBE = tube()
BODY = inner_body(TUBE)
EYE = np.array([0.0, 0.4, 2.0])
ACCELERATED = Config.from_dict({"predict": {"type": "ConstantAcceleration"}})
PRESETS = pytest.mark.parametrize("config", [Config(), Config.paper()], ids=["default", "paper"])
ARRAYS = ("vertices", "velocities", "covariance", "sigma", "vertex_reliability", "observed")


def assert_same(a, b):
    """Two results equal to the bit."""
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for name in ("reliability", "paper_score", "coverage", "state"):
        assert getattr(a, name) == getattr(b, name), name


def assert_finite(result):
    for name in ARRAYS:
        assert np.isfinite(getattr(result, name)).all(), name
    assert np.isfinite([result.reliability, result.paper_score, result.coverage]).all()


def swaying(k):
    """The tube's vertices in frame k."""
    return TUBE.vertices + [0.03 * np.sin(0.3 * k), 0.0, 0.02 * np.sin(0.2 * k)]


def cloud(k, count=3000, noise=0.002):
    return scan(swaying(k), TUBE, count, noise, seed=k)


def tracked(count, **how) -> Tracker:
    """A tracker after so many frames of the swaying tube."""
    tracker = Tracker(TUBE, **how)
    for k in range(count):
        tracker.step(cloud(k), timestamp=k / FPS, sensor_origin=EYE)
    return tracker


def worn(view, pose, count=40):
    """The results of the sample's first frames in a view, with its body in ``pose(k)`` or None, and their RMS errors (m)."""
    tracker, rng = Tracker(SHIRT, body=WEARER), np.random.default_rng(0)
    tracker.reset(vertices=SAMPLE.garment_vertices[0])
    for k in range(1, count):
        seen = Sensor(view).capture(SAMPLE, k, rng)
        result = tracker.step(seen.points, timestamp=k / FPS, sensor_origin=seen.sensor_origin, body_vertices=pose(k))
        yield result, rms(result.vertices - SAMPLE.garment_vertices[k])

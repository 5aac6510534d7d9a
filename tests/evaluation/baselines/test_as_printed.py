"""The printed method with velocity rows: the rows are those of the full gain, and without them it is the preset."""

import numpy as np
import pytest

from ddakf.config import Config
from ddakf.evaluation.baselines.filters.as_printed import AsPrinted, PrintedSettings
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import sample_surface
from ddakf.tracker import Tracker
from tests.evaluation.baselines.shapes import moved, tube


@pytest.fixture(scope="module")
def frames():
    garment, rng = tube(), np.random.default_rng(0)
    poses = [moved(garment.vertices, 0.01 * k, [0.008 * k, 0, 0]) for k in range(1, 7)]
    clouds = [sample_surface(pose, garment.faces, 3000, rng) for pose in poses]
    return [CapturedFrame(k, k / 30, cloud) for k, cloud in enumerate(clouds, 1)]


def followed(settings, frames, stretch=1.0):
    method = AsPrinted(settings)
    method.start(tube(), stretch * tube().vertices, None)
    return [method.step(frame) for frame in frames], method


def test_the_velocity_rows_are_those_of_the_full_gain():
    rng = np.random.default_rng(1)
    root, h = rng.normal(size=(6, 6)), rng.normal(size=(3, 3))
    P, H = root @ root.T, np.hstack([h @ h.T, np.zeros((3, 3))])
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(3))
    assert P[3:, :3] @ np.linalg.inv(P[:3, :3]) @ gain[:3] == pytest.approx(gain[3:])


def test_without_them_it_is_the_preset(frames):
    found, _ = followed(PrintedSettings(**PRESET), frames)
    tracker = Tracker(tube(), config=Config.paper())
    for frame, vertices in zip(frames, found, strict=True):
        assert np.array_equal(tracker.step(frame.points, timestamp=frame.timestamp).vertices, vertices)


PRESET = {
    "acceleration": 12.0, "speed_sd": 0.5, "lowest_sd": 0.001, "highest_sd": 0.05, "alpha": 0.9, "gate": 0.1, "stiffness": 1.0,
    "longest_correction": 0.02, "velocity_rows": False,
}  # fmt: skip


def test_velocities_follow_the_physics_step(frames):
    (both,), with_rows = followed(PrintedSettings(**PRESET | {"velocity_rows": True}), frames[:1], 1.05)
    (without_rows,), without = followed(PrintedSettings(**PRESET), frames[:1], 1.05)
    (geometric,), _ = followed(PrintedSettings(**PRESET | {"stiffness": 0.0}), frames[:1], 1.05)
    assert np.array_equal(both, without_rows), "positions of the first frame have the same rows"
    physics = without_rows - geometric
    change = with_rows._tracker._track.state.velocity - without._tracker._track.state.velocity
    assert np.linalg.norm(physics) > 1e-3
    assert (change * physics).sum() > 0.9 * np.linalg.norm(change) * np.linalg.norm(physics)

"""Empty clouds, gaps, loss and return."""

import numpy as np
import pytest

import ddakf
from ddakf import Config, data
from ddakf.evaluation.sensors import Sensor
from tests.lanes import every
from tests.stages.scenes import FPS, rms
from tests.tracker_runs import ACCELERATED, assert_finite, cloud, swaying, tracked


@pytest.mark.parametrize("nothing", [[], np.empty((0, 3)), np.full((100, 3), 500.0)], ids=["list", "array", "far away"])
def test_a_frame_without_the_garment_is_a_prediction(nothing):
    tracker = tracked(6)
    last = tracker.step(cloud(6), timestamp=6 / FPS)
    result = tracker.step(nothing, timestamp=7 / FPS)
    assert not result.observed.any()
    assert result.coverage == 0.0
    assert (result.sigma > last.sigma).all()
    assert rms(result.vertices - last.vertices - last.velocities / FPS) < 0.004
    assert_finite(result)


def test_two_empty_clouds_do_not_end_the_track():
    tracker = tracked(6)
    for k in (6, 7):
        empty = tracker.step([], timestamp=k / FPS)
    assert empty.state == "recovering", "nothing measures it"
    assert tracker.step(cloud(8), timestamp=8 / FPS).state == "tracking"


@pytest.mark.parametrize("config", [Config(), ACCELERATED], ids=["default", "accelerated"])
@pytest.mark.parametrize("gap", every(2, [0.3, 3.0, 100.0, 1e6]))
def test_a_gap_without_frames_is_a_long_prediction(gap, config):
    tracker, twin = tracked(6, config=config), tracked(6, config=config)
    after = tracker.step(cloud(6), timestamp=6 / FPS + gap)
    soon = twin.step(cloud(6), timestamp=6 / FPS)
    assert after.state == "tracking"
    assert_finite(after)
    assert rms(after.vertices - swaying(6)) < 0.03
    assert rms(soon.vertices - swaying(6)) < 0.012


@pytest.mark.parametrize("elsewhere", ["far away", "around it"])
def test_nonsense_is_a_loss_after_half_a_second_and_the_garment_comes_back(elsewhere):
    tracker, rng = tracked(10), np.random.default_rng(0)
    states = []
    for k in range(10, 30):
        size = (200, 3)
        points = rng.uniform(5, 6, size) if elsewhere == "far away" else rng.uniform(-1, 1.2, size)
        states.append(tracker.step(points, timestamp=k / FPS).state)
    assert states[0] == "recovering"
    assert "lost" not in states[:13]
    assert states[17] == states[-1] == "lost"
    for k in range(30, 46):
        result = tracker.step(cloud(k), timestamp=k / FPS)
    assert result.state != "lost", "what turned about itself meanwhile may be told by its low reliability"
    assert rms(result.vertices - swaying(45)) < 0.02


def test_a_lost_garment_that_comes_back_elsewhere_is_found():
    tracker, shift = tracked(10), np.array([0.35, 0.0, -0.2])
    for k in range(10, 75):
        result = tracker.step([], timestamp=k / FPS)
    assert result.state == "lost"
    for k in range(75, 85):
        result = tracker.step(cloud(k) + shift.astype(np.float32), timestamp=k / FPS)
    assert result.state != "lost", "how a tube has turned about itself meanwhile is not seen, and may be told"
    assert rms(result.vertices - swaying(84) - shift) < 0.015


@pytest.mark.parametrize("shift", [[0.0, 0.0, 0.0], [0.35, 0.0, -0.2]], ids=["in place", "elsewhere"])
def test_a_garment_that_reappears_is_followed_as_closely_as_before(shift):
    sequence, sensor, shift = data.sample(), Sensor("full", points=4000), np.array(shift)
    tracker, twin = (ddakf.Tracker(ddakf.Mesh(sequence.template, sequence.garment_faces)) for _ in range(2))
    for each in (tracker, twin):
        each.reset(sequence.garment_vertices[0])
    errors = []
    for k in range(1, 41):
        points, truth = sensor.capture(sequence, k, np.random.default_rng(k)).points, sequence.garment_vertices[k]
        seen = twin.step(points, timestamp=k / FPS)
        result = tracker.step([] if 6 <= k < 26 else points + (shift if k >= 26 else 0.0), timestamp=k / FPS)
        errors.append((rms(result.vertices - truth - shift), rms(seen.vertices - truth)))
    after, uninterrupted = np.mean(errors[-5:], axis=0)
    assert after < 1.3 * uninterrupted
    assert result.reliability > 0.8 * seen.reliability


def test_empty_clouds_are_a_loss_after_two_seconds():
    tracker = tracked(10)
    states = [tracker.step([], timestamp=(10 + k) / FPS).state for k in range(66)]
    assert "lost" not in states[:57]
    assert states[62] == states[-1] == "lost"

"""Gate of whole frames: one frame of nonsense is not followed, two in a row and what moves fast are."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Tracker
from ddakf.config import Omission
from ddakf.data import sample
from ddakf.evaluation.metrics import rmse_mm
from ddakf.evaluation.sensors import Sensor
from tests.tracker_runs import SHIRT, assert_same

SAMPLE, START = sample(), 36
OPEN = dataclasses.replace(Config(), reliability=dataclasses.replace(Config().reliability, gate_above=1.0))


def torn(frame: int) -> np.ndarray:
    """The cloud of a frame, each half of which is 8 cm from its place, and turned inside out; metres."""
    points = captured(frame)
    side = np.where(points[:, [0]] > np.median(points[:, 0]), 0.08, -0.08).astype(np.float32)
    return points * [1.0, 1.0, -1.0] + side * [[1.0, 1.0, 0.0]] + [0.0, 0.0, 2.0 * points[:, 2].mean()]


def captured(frame: int) -> np.ndarray:
    return Sensor(view="full", points=4000).capture(SAMPLE, frame, np.random.default_rng(frame)).points


def results(config: Config, spoiled=(), frames: int = 8, every: int = 1, turn: float = 0.0) -> list:
    """Results of frames after the start; the spoiled ones, from 1, show other things. The heading may be off by ``turn``, rad."""
    tracker = Tracker(SHIRT, config=config)
    tracker.reset(vertices=SAMPLE.garment_vertices[START])
    tracker._track = tracker._track._replace(drift=tracker._track.drift._replace(unseen_turn=turn))
    found = []
    for k in range(1, frames + 1):
        frame = START + k * every
        points = torn(frame) if k in spoiled else captured(frame)
        found.append(tracker.step(points, timestamp=frame / 30))
    return found


def error(result, k: int) -> float:
    return rmse_mm(result.vertices, SAMPLE.garment_vertices[START + k])


def test_after_one_frame_of_nonsense_the_garment_is_where_it_would_be_without():
    clean, spoiled, followed = results(Config()), results(Config(), {4}), results(OPEN, {4})
    assert error(followed[3], 4) > 40.0  # mm
    assert error(spoiled[3], 4) < 15.0
    assert spoiled[3].reliability < 0.5 * clean[3].reliability
    assert not spoiled[3].observed.any()
    assert spoiled[3].coverage == 0.0
    assert error(spoiled[4], 5) < error(clean[4], 5) + 3.0
    assert spoiled[4].reliability > clean[4].reliability - 0.05


def test_a_garment_of_uncertain_heading_is_held_too():
    """Its reliability is low all the time, and says nothing of a single frame."""
    spoiled = results(Config(), {4}, turn=1.0)
    assert max(each.reliability for each in spoiled) < 0.3
    assert not spoiled[3].observed.any()
    assert error(spoiled[4], 5) < 15.0


def test_what_was_held_is_claimed_less():
    clean, spoiled = results(Config()), results(Config(), {4})
    assert np.median(spoiled[3].sigma) > np.median(clean[3].sigma)


def test_a_second_frame_in_a_row_is_believed():
    once, twice = results(Config(), {4}), results(Config(), {4, 5})
    assert error(twice[4], 5) > error(once[4], 5) + 20.0


def test_a_frame_of_nonsense_teaches_nothing_about_the_places_of_the_cameras():
    tracker = Tracker(SHIRT)
    tracker.reset(vertices=SAMPLE.garment_vertices[0])
    for k in range(1, 40):
        cloud = Sensor("ring4").capture(SAMPLE, k, np.random.default_rng(k))
        points, first = cloud.points.copy(), (cloud.sensor_origin == cloud.sensor_origin[0]).all(axis=1)
        known = tracker._track.sensors
        if k > 30 and known.wait == 0:  # in every third frame the cameras are compared
            points[first] += np.float32([0.02, 0.0, 0.02])
            result = tracker.step(points + np.float32([0.1, 0.12, 0.0]), timestamp=k / 30, sensor_origin=cloud.sensor_origin)
            break
        tracker.step(points, timestamp=k / 30, sensor_origin=cloud.sensor_origin)
    assert not result.observed.any()
    np.testing.assert_array_equal(tracker._track.sensors.shift, known.shift)


@pytest.mark.parametrize("every", [1, 3])
def test_fast_motion_passes(every):
    """Up to 6 cm between frames."""
    for gated, free in zip(results(Config(), every=every), results(OPEN, every=every), strict=True):
        assert_same(gated, free)


def test_a_frame_whose_work_was_cut_is_not_held():
    tracker = Tracker(SHIRT, config=dataclasses.replace(Config(), omission=Omission(points_growth=4.0)))
    tracker.reset(vertices=SAMPLE.garment_vertices[START])
    for k, budget in ((1, 60.0), (2, 60.0), (3, 60.0), (4, 1e-6)):
        result = tracker.step(captured(START + k), timestamp=(START + k) / 30, budget=budget)
    assert result.usage.widening > 10.0
    assert result.observed.mean() > 0.4

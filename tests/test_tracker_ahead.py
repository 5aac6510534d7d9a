"""A result moved on to a later time: nearer to what is there then, less certain, and the tracker none the wiser."""

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.errors import InvalidArgument
from tests.stages.scenes import FPS, rms, scan
from tests.tracker_runs import ACCELERATED, ARRAYS, BODY, EYE, PRESETS, TUBE, assert_finite, assert_same, cloud, swaying, tracked


@pytest.fixture
def steady():
    """A tracker after 20 frames of the swaying tube, and its last result."""
    tracker = tracked(20)
    return tracker, tracker.step(cloud(20), timestamp=20 / FPS, sensor_origin=EYE)


@pytest.mark.parametrize("config", [Config(), Config.paper(), ACCELERATED], ids=["default", "paper", "accelerated"])
def test_nothing_ahead_is_the_result_itself(config):
    tracker = tracked(2, config=config)
    result = tracker.step(cloud(2), timestamp=2 / FPS, sensor_origin=EYE)
    assert_same(tracker.predicted(result, 0.0), result)
    assert_finite(tracker.predicted(result, 0.1))


@pytest.mark.parametrize("frames", [1, 3])
def test_it_is_nearer_to_what_is_there_then(steady, frames):
    tracker, result = steady
    later = swaying(20 + frames)
    assert rms(tracker.predicted(result, frames / FPS).vertices - later) < 0.9 * rms(result.vertices - later)


def test_uncertainty_grows_with_time_and_faster_than_it(steady):
    tracker, result = steady
    sigma = np.array([tracker.predicted(result, k / FPS).sigma.mean() for k in range(1, 5)])
    assert (np.diff(sigma) > 0).all()
    variance = sigma**2 - (result.sigma**2).mean()
    assert variance[3] > 16 * variance[0] * 0.9


@PRESETS
def test_the_tracker_stays_as_it_is_and_all_is_finite(config):
    tracker, other = tracked(3, config=config), tracked(3, config=config)
    result = tracker.step(cloud(3), timestamp=3 / FPS, sensor_origin=EYE)
    other.step(cloud(3), timestamp=3 / FPS, sensor_origin=EYE)
    before = [getattr(result, name).copy() for name in ARRAYS]
    for seconds in (0.03, 0.5, 1e6):
        later = tracker.predicted(result, seconds)
        assert_finite(later)
        assert (later.sigma > 0).all()
    for name, array in zip(ARRAYS, before, strict=True):
        assert np.array_equal(getattr(result, name), array)
    assert tracker.snapshot() == other.snapshot()
    more = {"timestamp": 4 / FPS, "sensor_origin": EYE}
    assert_same(tracker.step(cloud(4), **more), other.step(cloud(4), **more))


def test_a_body_takes_the_garment_along():
    tracker = Tracker(TUBE, body=BODY)
    drift = np.array([0.6, 0.0, 0.0]) / FPS
    for k in range(1, 11):
        body = BODY.vertices + k * drift
        result = tracker.step(cloud(0) + np.float32(k * drift), timestamp=k / FPS, sensor_origin=EYE, body_vertices=body)
    later = tracker.predicted(result, 3 / FPS)
    assert np.allclose((later.vertices - result.vertices).mean(axis=0), 3 * drift, atol=0.2 * rms(3 * drift[None]))
    gone = tracker.step(cloud(0) + np.float32(11 * drift), timestamp=11 / FPS, sensor_origin=EYE)
    assert (tracker.predicted(gone, 1 / FPS).vertices - gone.vertices).mean(axis=0)[0] > 0.5 * drift[0]


def test_the_error_of_what_sways_with_its_body_is_claimed_later():
    """The body misses its own motion, and all of the garment with it; 15 cm to either side, 1.5 times a second."""
    tracker, rows, frames = Tracker(TUBE, body=BODY), [], 40
    aside = 0.15 * np.sin(3.0 * np.pi * np.arange(frames + 2) / FPS)[:, None] * [1.0, 0.0, 0.0]
    for k in range(frames):
        points = scan(TUBE.vertices + aside[k], TUBE, 3000, 0.002, seed=k)
        seen = {"sensor_origin": EYE + aside[k], "body_vertices": BODY.vertices + aside[k]}
        later = tracker.predicted(tracker.step(points, timestamp=k / FPS, **seen), 2 / FPS)
        off = later.vertices - TUBE.vertices - aside[k + 2]
        rows.append((np.square(off[:, 0]).mean(), later.covariance[:, 0, 0].mean()))
    error2, claimed2 = np.mean(rows[10:], axis=0)
    assert 0.5 < error2 / claimed2 < 2.0


def test_a_body_moves_on_for_the_longest_step_alone():
    tracker, speed = Tracker(TUBE, body=BODY), np.array([0.6, 0.0, 0.0])
    for k in range(1, 11):
        pose = BODY.vertices + k / FPS * speed
        result = tracker.step(cloud(0) + np.float32(k / FPS * speed), timestamp=k / FPS, sensor_origin=EYE, body_vertices=pose)
    moved = (tracker.predicted(result, 60.0).vertices - result.vertices).mean(axis=0)
    assert moved[0] == pytest.approx(0.6 * tracker.config.predict.longest_step, rel=0.2)


def test_a_restored_and_a_newly_configured_tracker_predict_the_same():
    """Also where frames are not a 30th of a second apart, against which a time ahead is long or short."""
    tracker = Tracker(TUBE)
    for k in range(6):
        result = tracker.step(cloud(k), timestamp=k / 10, sensor_origin=EYE)
    later = tracker.predicted(result, 0.15)
    for other in (Tracker.restore(tracker.snapshot()), tracker.configured(tracker.config)):
        assert_same(other.predicted(result, 0.15), later)


@pytest.mark.parametrize("seconds", [-0.1, float("nan"), float("inf"), "a", True, None])
def test_a_time_that_cannot_be_is_refused(steady, seconds):
    tracker, result = steady
    with pytest.raises(InvalidArgument, match="seconds"):
        tracker.predicted(result, seconds)


def test_only_the_last_result_can_be_moved_on(steady):
    tracker, result = steady
    tracker.step(cloud(21), timestamp=21 / FPS, sensor_origin=EYE)
    with pytest.raises(InvalidArgument, match="the last step"):
        tracker.predicted(result, 0.1)
    with pytest.raises(InvalidArgument, match="the last step, got NoneType"):
        tracker.predicted(None, 0.1)
    with pytest.raises(InvalidArgument, match="the last step"):
        Tracker(Mesh(TUBE.vertices[::-1], (len(TUBE.vertices) - 1 - TUBE.faces)[:, ::-1])).predicted(result, 0.1)

"""Frames without the body's pose: it is moved on as it last moved, for some tenths of a second."""

import numpy as np
import pytest

from ddakf import Tracker
from ddakf.body import contact
from tests.stages.scenes import rms
from tests.tracker_runs import BODY, EYE, FPS, SAMPLE, TUBE, cloud, swaying, worn

SPEED = np.array([0.6, 0.0, 0.0])  # m/s


def walked(tracker, count, first=1):
    """The results of so many frames in which garment and body move on."""
    for k in range(first, first + count):
        place = k / FPS * SPEED
        how = {"sensor_origin": EYE + place, "body_vertices": BODY.vertices + place}
        yield tracker.step(cloud(0) + np.float32(place), timestamp=k / FPS, **how)


def test_a_body_without_a_pose_moves_on_and_then_is_not_known():
    tracker = Tracker(TUBE, body=BODY)
    assert contact.moved_on(tracker._setup.body, tracker._track.body, 1 / FPS) is None
    *_, _ = walked(tracker, 3)
    body, track = tracker._setup.body, tracker._track.body
    moved = contact.moved_on(body, track, 1 / FPS) - BODY.vertices - 4 / FPS * SPEED
    assert np.abs(moved).max() < 0.3 * rms(SPEED[None] / FPS)
    assert contact.moved_on(body, track, contact.LONGEST_UNPOSED + 0.01) is None


def test_two_missing_poses_move_it_as_far_as_one_that_is_as_late():
    tracker, other = Tracker(TUBE, body=BODY), Tracker(TUBE, body=BODY)
    for each in (tracker, other):
        *_, _ = walked(each, 3)
    for k in (4, 5):
        tracker.step(cloud(0), timestamp=k / FPS, sensor_origin=EYE)
    later = contact.moved_on(other._setup.body, other._track.body, 2 / FPS)
    np.testing.assert_allclose(tracker._track.body.vertices, later, atol=1e-6)
    *_, _ = walked(tracker, 1, first=6)
    assert rms(tracker._track.body.motion - SPEED) < 0.02
    assert tracker._track.body.unposed == 0.0


@pytest.mark.slow
def test_a_missing_pose_costs_hidden_cloth_nothing():
    """Seen from one camera, one pose in seven missing: neither its error nor what is claimed of it grows."""
    errors = []
    for missing in (99, 7):
        found = worn("front", lambda k, missing=missing: None if k % missing == missing - 1 else SAMPLE.body_vertices[k])
        errors += [(missing, error, result.sigma.mean()) for result, error in found]
    every, some = (np.mean([row[1:] for row in errors if row[0] == missing], axis=0) for missing in (99, 7))
    assert some[0] < 1.1 * every[0]
    assert some[1] < 1.1 * every[1]


def in_pairs(tracker, apart, pose, count=16, missing=99):
    """Results of frames two of which are ``apart`` seconds apart, of a garment at ``pose(time)``, the body's scatter 3 mm."""
    rng = np.random.default_rng(0)
    for k in range(2, count):
        time = k // 2 / 15 + k % 2 * apart
        body = None if k % missing == missing - 1 else BODY.vertices + pose(time) + 0.003 * rng.normal(size=3)
        how = {"sensor_origin": EYE + pose(time), "body_vertices": body}
        yield time, tracker.step(cloud(k - k % 2) + np.float32(pose(time)), timestamp=time, **how)


@pytest.mark.parametrize("apart", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_frames_that_are_very_close_do_not_throw_a_garment_whose_body_scatters(apart, speed):
    """As those of two cameras: what a body scatters by is no motion of so short a time."""
    tracker, walk = Tracker(TUBE, body=BODY), np.array([speed, 0.0, 0.0])
    for k, (time, result) in enumerate(in_pairs(tracker, apart, lambda time: time * walk, missing=5), 2):
        assert rms(result.vertices - swaying(k - k % 2) - time * walk) < 0.03
        assert k == 2 or rms(result.velocities - walk) < 3.0
    ahead = tracker.predicted(result, 0.05).vertices - result.vertices
    assert rms(ahead - 0.05 * walk) < 0.15


@pytest.mark.parametrize("given", [True, False])
def test_velocities_of_a_start_are_of_the_world(given):
    """With a body too: it carries the garment, whose velocity on it is the difference."""
    tracker = Tracker(TUBE, body=BODY)
    tracker.reset(TUBE.vertices, velocities=np.tile(SPEED, (TUBE.n_vertices, 1)) if given else None)
    (result,) = walked(tracker, 1)
    assert rms(result.vertices - TUBE.vertices - SPEED / FPS) < 0.004
    assert rms(result.velocities - SPEED) < 0.15


def test_a_snapshot_within_a_gap_of_poses_goes_on_the_same():
    tracker = Tracker(TUBE, body=BODY)
    *_, _ = walked(tracker, 3)
    tracker.step(cloud(0), timestamp=4 / FPS, sensor_origin=EYE)
    other = Tracker.restore(tracker.snapshot())
    one, same = (each.step(cloud(0), timestamp=5 / FPS, sensor_origin=EYE) for each in (tracker, other))
    np.testing.assert_array_equal(one.vertices, same.vertices)

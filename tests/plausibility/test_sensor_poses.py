"""Sensors that are misplaced: found where two of them see the same surface, and nothing where they are right."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Tracker
from ddakf.errors import InvalidSnapshot
from ddakf.evaluation.sensors import Sensor
from ddakf.plausibility import sensor_poses
from ddakf.stages.frame_input import MAX_SENSORS
from tests.stages.scenes import FPS, rms, scan
from tests.tracker_runs import EYE, SAMPLE, SHIRT, TUBE, assert_same, cloud

GIVEN = dataclasses.replace(Config(), sensor_poses=dataclasses.replace(Config().sensor_poses, sd=0.0))
EYES = np.array([[2.0, 0.4, 0.0], [-1.0, 0.4, 1.7], [-1.0, 0.4, -1.7]])
SHIFTS = np.array([[0.012, 0.0, -0.004], [-0.006, 0.003, 0.009], [0.003, -0.004, -0.008]])


def around(k, shifts, eyes=EYES, count=2000, noise=0.002):
    """Cloud and origins of the tube in frame k, seen from all sides by each sensor, misplaced by (C, 3) shifts."""
    parts = [scan(TUBE.vertices, TUBE, count, noise, seed=[k, sensor]) + shift for sensor, shift in enumerate(shifts)]
    return np.concatenate(parts), np.repeat(eyes + shifts, count, axis=0)


def looked(shifts, frames=12, config=None, **how):
    """A tracker after so many frames of the tube."""
    tracker = Tracker(TUBE, config=config)
    tracker.reset(TUBE.vertices)
    for k in range(frames):
        points, origin = around(k, shifts, **how)
        tracker.step(points, timestamp=k / FPS, sensor_origin=origin)
    return tracker


def in_order(tracker, eyes):
    """The shifts of a tracker's sensors in the order of (C, 3) origins."""
    known = tracker._track.sensors
    return known.shift[np.linalg.norm(eyes[:, None] - known.origin, axis=2).argmin(axis=1)]


def captured(shift, frames=40, config=None):
    """Results of the sample seen by four cameras, each misplaced by a share of ``shift`` metres, with their errors in metres."""
    tracker, rng = Tracker(SHIRT, config=config), np.random.default_rng(3)
    tracker.reset(vertices=SAMPLE.garment_vertices[0])
    directions = rng.normal(size=(4, 3))
    directions -= directions.mean(axis=0)
    for k in range(1, frames):
        points, origin = Sensor("ring4").capture(SAMPLE, k, rng)
        moved = shift * directions[np.unique(origin, axis=0, return_inverse=True)[1].ravel()]
        result = tracker.step(points + moved, timestamp=k / FPS, sensor_origin=origin + moved)
        yield result, rms(result.vertices - SAMPLE.garment_vertices[k])


def test_shifts_across_the_surface_are_found_but_for_their_mean():
    found = in_order(looked(SHIFTS), EYES + SHIFTS)
    expected = (SHIFTS - SHIFTS.mean(axis=0))[:, [0, 2]]
    np.testing.assert_allclose(found[:, [0, 2]], expected, atol=1e-3)
    assert np.abs(found[:, 1]).max() < 0.004  # along the tube nothing tells them


def test_sensors_that_are_right_are_left_where_they_are():
    assert np.abs(looked(np.zeros((3, 3)))._track.sensors.shift).max() < 1e-3
    results = [result for result, _ in captured(0.0)]
    assert not [warning for result in results for warning in result.warnings]


@pytest.mark.slow
def test_a_garment_between_misplaced_cameras_is_found_and_they_are_told():
    corrected, given = list(captured(0.008)), list(captured(0.008, config=GIVEN))
    late = slice(10, None)
    assert np.mean([error for _, error in corrected[late]]) < 0.8 * np.mean([error for _, error in given[late]])
    (warning,) = corrected[-1][0].warnings
    assert (warning.code, warning.field) == ("sensors_off", "sensor_origin")
    assert "mm from where the others see them" in warning.message


def test_what_is_common_to_all_widens_the_covariance():
    sensors = sensor_poses.unknown(EYES)._replace(shift=0.003 * np.eye(3))  # in each direction 2, -1 and -1 mm about their mean
    assert sensors.common2 == pytest.approx(0.001**2)  # 3 mm^2 for each of three
    wide, narrow = looked(3.0 * SHIFTS), looked(np.zeros((3, 3)))
    last = around(99, np.zeros((3, 3)))
    known = wide._track.sensors
    results = [each.step(last[0], timestamp=1.0, sensor_origin=last[1]) for each in (wide, narrow)]
    assert known.common2 > 1e-5
    assert np.median(results[0].sigma**2) > np.median(results[1].sigma**2) + 0.5 * known.common2


@pytest.mark.parametrize("origin", [EYE, np.tile(EYE, (3000, 1)), None], ids=["one", "one for each point", "none"])
def test_one_sensor_is_taken_as_given(origin):
    ours, given = Tracker(TUBE), Tracker(TUBE, config=GIVEN)
    for k in range(4):
        a, b = (each.step(cloud(k), timestamp=k / FPS, sensor_origin=origin) for each in (ours, given))
        assert_same(a, b)
    assert ours._track.sensors is None


def test_a_sensor_without_points_keeps_its_shift():
    tracker = looked(SHIFTS)
    before = in_order(tracker, EYES + SHIFTS)
    for k in range(12, 18):
        points, origin = around(k, SHIFTS)
        tracker.step(points[:4000], timestamp=k / FPS, sensor_origin=origin[:4000])
    assert len(tracker._track.sensors.origin) == 3
    np.testing.assert_allclose(in_order(tracker, EYES + SHIFTS)[2], before[2], atol=0.002)
    np.testing.assert_allclose(before[2], in_order(looked(SHIFTS, 18), EYES + SHIFTS)[2], atol=0.001)


def test_one_known_sensor_alone_is_moved_by_its_shift_however_its_place_is_given():
    one, each = looked(SHIFTS), looked(SHIFTS)
    for k in range(12, 15):
        points, origin = (array[:2000] for array in around(k, SHIFTS))
        results = [
            tracker.step(points, timestamp=k / FPS, sensor_origin=place) for tracker, place in ((one, origin[0]), (each, origin))
        ]
        assert_same(*results)


def test_sensors_sit_where_they_say_once_their_errors_are_taken_for_none():
    tracker = looked(SHIFTS).configured(GIVEN)
    points, origin = around(12, SHIFTS)
    assert "sensors_off" not in {warning.code for warning in tracker.step(points, timestamp=1.0, sensor_origin=origin).warnings}
    assert tracker._track.sensors is None


def test_sensors_that_are_carried_stay_the_same():
    tracker = Tracker(TUBE)
    for k in range(12):
        points, origin = around(k, SHIFTS, EYES + [0.0, 0.03 * k, 0.0])
        tracker.step(points, timestamp=k / FPS, sensor_origin=origin)
    assert len(tracker._track.sensors.origin) == 3
    assert in_order(tracker, origin[::2000])[0, 0] == pytest.approx(SHIFTS[0, 0] - SHIFTS[:, 0].mean(), abs=1e-3)


def test_a_crowd_of_sensors_that_come_and_go_is_forgotten():
    tracker = Tracker(TUBE)
    for k in range(2 * MAX_SENSORS // 3):
        points, origin = around(k, np.zeros((3, 3)), EYES + [0.0, 0.0, 5.0 * k], count=300)
        tracker.step(points, timestamp=k / FPS, sensor_origin=origin)
        assert 3 <= len(tracker._track.sensors.origin) <= MAX_SENSORS


def test_a_garment_with_vertices_astray_costs_no_memory():
    tracker = looked(SHIFTS, 4)
    track = tracker._track
    position = track.state.position.copy()
    position[0] += 1e4
    tracker._track = track._replace(state=track.state._replace(position=position), sensors=track.sensors._replace(wait=0))
    points, origin = around(4, SHIFTS)
    assert np.isfinite(tracker.step(points, timestamp=4 / FPS, sensor_origin=origin).vertices).all()


def test_points_that_no_two_sensors_share_say_nothing():
    below, above = (scan(TUBE.vertices, TUBE, 3000, seed=seed) for seed in (1, 2))
    middle = TUBE.vertices[:, 1].mean()
    below, above = below[below[:, 1] < middle - 0.05], above[above[:, 1] > middle + 0.05]
    tracker, origin = Tracker(TUBE), np.repeat(EYES[:2], [len(below), len(above)], axis=0)
    for k in range(4):
        tracker.step(np.concatenate([below, above]), timestamp=k / FPS, sensor_origin=origin)
    assert not tracker._track.sensors.information.any()
    assert not tracker._track.sensors.shift.any()


@pytest.mark.parametrize("frames", [1, 5])
def test_a_snapshot_has_the_sensors(frames):
    tracker = looked(SHIFTS, frames)
    twin = Tracker.restore(tracker.snapshot())
    for k in range(frames, frames + 4):
        points, origin = around(k, SHIFTS)
        a, b = (each.step(points, timestamp=k / FPS, sensor_origin=origin) for each in (tracker, twin))
        assert_same(a, b)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("shift", np.zeros((2, 3))),
        ("shift", np.full((3, 3), np.nan)),
        ("shift", np.full((3, 3), 1e6)),
        ("information", -np.eye(9)),
        ("vector", np.zeros(8)),
        ("wait", -1),
        ("time", "now"),
    ],
)
def test_sensors_that_are_none_are_refused(name, value):
    tracker = looked(SHIFTS, 3)
    tracker._track = tracker._track._replace(sensors=tracker._track.sensors._replace(**{name: value}))
    with pytest.raises(InvalidSnapshot, match=name if name not in ("wait",) else "sensors"):
        Tracker.restore(tracker.snapshot())

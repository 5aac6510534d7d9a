"""Degradations: effect and window of a script on a stream, reproducibly."""

import numpy as np
import pytest

from ddakf.data import SAMPLE
from ddakf.evaluation.datasets import open_dataset
from ddakf.evaluation.sensors.degradations import (
    DISTURBANCES,
    FRAMES,
    SCRIPTS,
    Disc,
    Dropout,
    Event,
    Fast,
    Gap,
    HalfSpace,
    Noise,
    Outliers,
    Script,
    degraded_runs,
)
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.tracking.sources import source_of

FRONT = list(source_of(open_dataset(SAMPLE), Sensor(view="front", points=2000), frames="0:13"))
RING = list(source_of(open_dataset(SAMPLE), Sensor(view="ring4", points=2000), frames="0:4"))
FULL = list(source_of(open_dataset(SAMPLE), Sensor(view="full", points=2000), frames="0:13"))


def played(*events, frames=FULL, seed=1):
    return list(Script("test", tuple(Event(*event) for event in events)).apply(frames, seed))


def test_frames_outside_every_window_come_as_they_are():
    out = played((3, 5, Noise(0.02)))
    assert [degraded for _, degraded in out] == [3 <= k < 5 for k in range(len(FULL))]
    for (frame, degraded), before in zip(out, FULL, strict=True):
        assert np.array_equal(frame.points, before.points) != degraded
        assert frame.timestamp == before.timestamp


@pytest.mark.parametrize("what", [Noise(0.01), Dropout(0.4), HalfSpace(0.5), Disc(0.2), Outliers(0.1)], ids=str)
@pytest.mark.parametrize("frames", [FULL[:3], FRONT[:3], RING], ids=["full", "front", "ring4"])
def test_a_degradation_is_the_same_for_the_same_seed_and_another_for_another(what, frames):
    first, again, other = (played((0, 3, what), frames=frames, seed=seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a.points, b.points) for (a, _), (b, _) in zip(first, again, strict=True))
    assert not all(np.array_equal(a.points, b.points) for (a, _), (b, _) in zip(first, other, strict=True))
    for frame, _ in first:
        origin = frame.sensor_origin
        assert origin is None or origin.shape == (3,) or origin.shape == frame.points.shape


def test_an_event_does_the_same_whatever_else_happens():
    alone, beside = played((4, 6, HalfSpace(0.5))), played((4, 6, HalfSpace(0.5)), (1, 3, Noise(0.02)))
    assert np.array_equal(alone[5][0].points, beside[5][0].points)


def test_noise_has_the_standard_deviation_that_it_says():
    moved = played((0, 1, Noise(0.02)))[0][0].points - FULL[0].points
    assert moved.std() == pytest.approx(0.02, rel=0.05)


@pytest.mark.parametrize("share", [0.4, 1.0])
@pytest.mark.parametrize("kind", [Dropout, HalfSpace])
def test_a_share_of_the_points_is_missing(kind, share):
    frame = played((0, 1, kind(share)))[0][0]
    assert 1 - len(frame.points) / len(FULL[0].points) == pytest.approx(share, abs=0.05)


def test_a_half_space_is_missing_on_one_side_of_a_plane_that_stays():
    out = played((0, 9, HalfSpace(0.5, direction=(1.0, 0.0, 0.0))))
    for (frame, _), before in zip(out[:9], FULL, strict=False):
        assert frame.points[:, 0].max() <= np.median(before.points[:, 0]) + 1e-6


def test_a_disc_hides_what_lies_behind_it_as_seen_from_the_sensor():
    frame, before = played((0, 1, Disc(0.15)), frames=FRONT)[0][0], FRONT[0]
    left = {tuple(p) for p in frame.points}
    gone = np.array([p for p in before.points if tuple(p) not in left])
    assert 0 < len(gone) < len(before.points)
    assert np.linalg.norm(gone[:, :2] - gone[:, :2].mean(axis=0), axis=1).max() < 0.25


def test_outliers_replace_a_share_of_the_points():
    frame = played((0, 1, Outliers(0.1)))[0][0]
    changed = (frame.points != FULL[0].points).any(axis=1)
    assert changed.mean() == pytest.approx(0.1, abs=0.03)


def test_after_a_gap_the_next_frame_tells_by_its_time():
    out = played((4, 8, Gap()))
    assert [frame.number for frame, _ in out] == [1, 2, 3, 4, 9, 10, 11, 12]
    assert out[4][0].timestamp - out[3][0].timestamp == pytest.approx(5 / 30)
    assert [degraded for _, degraded in out] == [False] * 4 + [True] + [False] * 3


@pytest.mark.parametrize("nth", [2, 3])
def test_fast_motion_skips_frames_at_the_same_rate(nth):
    out = played((0, 12, Fast(nth)))
    assert [frame.number for frame, _ in out] == list(range(nth, 13, nth))
    assert np.diff([frame.timestamp for frame, _ in out]) == pytest.approx(1 / 30)


@pytest.mark.parametrize("script", [*SCRIPTS, *DISTURBANCES], ids=lambda script: script.name)
def test_at_least_half_of_the_frames_of_every_script_are_undegraded(script):
    frames = [FULL[0]] * FRAMES
    degraded = [flag for _, flag in script.apply(frames, 1)]
    assert 0 < np.mean(degraded) <= 0.5
    assert not any(script.degrades(k) for k in range(10))  # something to compare with
    assert not any(script.degrades(k) for k in range(FRAMES - 10, FRAMES))


def test_every_sequence_runs_through_every_script_in_every_view():
    runs = degraded_runs([("a", True), ("b", False)])
    views = {"b": {("full", False), ("front", False)}, "a": {("full", False), ("front", False), ("front", True)}}
    assert len(set(runs)) == len(runs) == 5 * len(SCRIPTS)
    for name, expected in views.items():
        assert {(run.view, run.give_body) for run in runs if run.sequence == name} == expected

"""Admission: a frame is checked in full before it counts, and gets a sensor origin only where it has none."""

import numpy as np
import pytest

from ddakf import Tracker
from ddakf.errors import InvalidFrame
from ddakf.plausibility import admission
from ddakf.types import FrameInput
from tests.tracker_runs import EYE, TUBE, cloud

TRACKER = Tracker(TUBE)


def admit(points, origin=None, timestamp=0.1):
    return admission.admit(TRACKER._setup, TRACKER._track, FrameInput(points, timestamp, origin, None))


def test_a_given_origin_and_a_cloud_of_all_sides_stay_as_they_are():
    frame, track = admit(cloud(0), EYE)
    np.testing.assert_array_equal(frame.sensor_origin, EYE)
    assert not track.view.one_sided
    assert admit(cloud(0))[0].sensor_origin is None


def test_one_side_without_an_origin_is_seen_from_that_side():
    points = cloud(0)
    frame, track = admit(points[points[:, 2] > 0.05])
    assert track.view.one_sided
    toward = frame.sensor_origin - frame.points.mean(axis=0)
    assert toward[2] / np.linalg.norm(toward) > 0.8


@pytest.mark.parametrize(
    ("points", "timestamp", "field"),
    [(cloud(0)[:, :2], 0.1, "points"), (1000 * cloud(0), 0.1, "points"), (cloud(0), np.nan, "timestamp")],
    ids=["shape", "millimetres", "time"],
)
def test_what_is_wrong_is_refused_by_name(points, timestamp, field):
    with pytest.raises(InvalidFrame, match=field):
        admit(points, timestamp=timestamp)

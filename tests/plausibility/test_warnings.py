"""Warnings: none about good input, each code once a frame, and only of signs that last."""

from typing import get_args

import numpy as np
import pytest

from ddakf import Tracker
from ddakf.evaluation.sensors import Sensor
from ddakf.plausibility import warnings
from ddakf.plausibility.warnings import CHECKS, Check
from ddakf.results import WarningCode
from ddakf.types import Sign
from tests.lanes import every
from tests.stages.scenes import FPS
from tests.tracker_runs import EYE, SAMPLE, SHIRT, TUBE, WEARER, cloud


@pytest.mark.parametrize("stride", every(2, [1, 3]))
@pytest.mark.parametrize("view", ["full", "front", "ring4", "front+body"])
def test_good_input_has_no_warnings(view, stride):
    view, _, body = view.partition("+")
    tracker = Tracker(SHIRT, body=WEARER if body else None)
    tracker.reset(SAMPLE.garment_vertices[0])
    for k in range(stride, 15 * stride, stride):
        points, eye = Sensor(view, points=4000).capture(SAMPLE, k, np.random.default_rng([1, k]))
        if k % 5 == 4:
            points, eye = points[:0], None
        worn = SAMPLE.body_vertices[k] if body else None
        result = tracker.step(points, timestamp=k / FPS, sensor_origin=eye, body_vertices=worn)
        assert result.warnings == ()


def test_a_sign_is_told_once_it_has_lasted(monkeypatch):
    shown = iter("101110111")
    check = Check(lambda problem, estimate: Sign("points", "odd") if next(shown) == "1" else None, 3)
    monkeypatch.setattr(warnings, "CHECKS", {"length_unit": check})
    tracker, told = Tracker(TUBE), ""
    for k in range(12):
        empty = k in (2, 6, 7)  # these say nothing either way
        points = cloud(k)[: 0 if empty else None]
        told += str(len(tracker.step(points, timestamp=k / FPS, sensor_origin=EYE).warnings))
    assert told == "000001000001"


def test_a_refused_frame_leaves_the_signs_as_they_were():
    tracker = Tracker(TUBE)
    tracker.step(cloud(0), timestamp=0.0)
    before = tracker._track.signs, tracker._track.view
    with pytest.raises(ValueError, match="points"):
        tracker.step(cloud(0)[:, :2], timestamp=1.0)
    assert (tracker._track.signs, tracker._track.view) == before


def test_every_check_has_a_code_of_its_own():
    assert set(CHECKS) == set(get_args(WarningCode))

"""Units: what is certain to be wrong is refused, what looks wrong is told."""

import numpy as np
import pytest

from ddakf import Mesh, Tracker
from ddakf.errors import InvalidFrame, InvalidMesh
from ddakf.plausibility.units import extent
from tests.stages.scenes import FPS
from tests.tracker_runs import BODY, EYE, TUBE, assert_same, cloud


def codes(result):
    return {warning.code for warning in result.warnings}


SCALES = {1000: "looks like millimetres", 100: "centimetres", 39.37: "inches", 20: "20", 0.001: "the other were in millimetres"}
UNEVEN = [0.03, 60.0, 0.03, 0.03, 600.0, 0.03], [30.0, 0.5, 90.0, 0.1]  # s


@pytest.mark.parametrize(("factor", "words"), SCALES.items())
def test_a_first_cloud_of_another_scale_is_refused_and_the_next_good_one_tracked(factor, words):
    tracker, fresh = Tracker(TUBE), Tracker(TUBE)
    for _ in range(3):
        with pytest.raises(InvalidFrame, match=words) as refused:
            tracker.step(factor * cloud(0), timestamp=0.0)
    assert refused.value.field == "points"
    assert_same(tracker.step(cloud(0), timestamp=0.0), fresh.step(cloud(0), timestamp=0.0))


@pytest.mark.parametrize(("factor", "told"), [(0.1, True), (0.5, False)])
def test_a_garment_that_is_smaller_than_any_is_told(factor, told):
    """Garment and cloud in the wrong unit agree with each other."""
    tracker = Tracker(Mesh(factor * TUBE.vertices, TUBE.faces))
    for k in range(4):
        result = tracker.step(factor * cloud(k), timestamp=k / FPS)
    assert ("length_unit" in codes(result)) == told


@pytest.mark.parametrize("factor", [0.2, 1, 5])
def test_a_cloud_of_about_the_scale_is_tracked(factor):
    Tracker(TUBE).step(factor * cloud(0), timestamp=0.0)


def test_a_scene_that_contains_the_garment_is_tracked():
    room = np.random.default_rng(0).uniform(-6, 6, (8000, 3))
    seen = cloud(0)[cloud(0)[:, 2] > TUBE.vertices[:, 2].mean()]
    room = np.concatenate([room, seen])
    assert extent(room) > 10 * TUBE.size
    assert not Tracker(TUBE).step(room, timestamp=0.0, sensor_origin=EYE).warnings


@pytest.mark.parametrize(
    ("start", "field", "words"),
    [
        (dict(vertices=1000 * TUBE.vertices), "vertices", "looks like millimetres"),
        (dict(vertices=39.37 * TUBE.vertices), "vertices", "looks like inches"),
        (dict(velocities=np.full_like(TUBE.vertices, 300.0)), "velocities", "metres per second"),
    ],
)
def test_a_start_in_another_unit_is_refused(start, field, words):
    tracker, fresh = Tracker(TUBE), Tracker(TUBE)
    with pytest.raises(InvalidFrame, match=words) as refused:
        tracker.reset(**start)
    assert refused.value.field == field
    assert_same(tracker.step(cloud(0), timestamp=0.0), fresh.step(cloud(0), timestamp=0.0))


def test_a_garment_may_start_crumpled_or_thrown():
    Tracker(TUBE).reset(vertices=0.01 * TUBE.vertices, velocities=np.full_like(TUBE.vertices, 30.0))


@pytest.mark.parametrize("factor", [1000, 100])
def test_a_garment_or_a_body_of_another_unit_is_refused(factor):
    large = Mesh(factor * TUBE.vertices, TUBE.faces)
    for given, field in (({"garment": large}, "garment"), ({"garment": TUBE, "body": large}, "body")):
        with pytest.raises(InvalidMesh, match="at most 10 in size") as refused:
            Tracker(**given)
        assert refused.value.field == field


def test_few_points_have_no_size():
    Tracker(TUBE).step(1000 * cloud(0)[:50], timestamp=0.0)


def test_stray_points_do_not_change_the_extent():
    points = cloud(0)
    strewn = np.concatenate([points, np.full((len(points) // 20, 3), 500.0, np.float32)])
    assert extent(strewn) == pytest.approx(extent(points), rel=0.15)
    assert extent(points) == pytest.approx(np.ptp(points, axis=0).max(), rel=0.15)


def test_another_scale_after_the_start_is_told():
    tracker = Tracker(TUBE)
    for k in range(5):
        assert not tracker.step(cloud(k), timestamp=k / FPS).warnings
    for k in range(5, 12):
        result = tracker.step(1000 * cloud(k), timestamp=k / FPS)
    assert {"length_unit", "nothing_in_reach"} <= codes(result)
    (told,) = (warning for warning in result.warnings if warning.code == "length_unit")
    assert told.field == "points"
    assert "millimetres" in told.message


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, "millimetres"), (100.0, "centimetres"), (39.37, "inches")])
def test_a_garment_that_no_person_wears_is_refused_with_the_unit_it_looks_like(factor, unit):
    with pytest.raises(InvalidMesh, match=unit) as refused:
        Tracker(Mesh(factor * TUBE.vertices, TUBE.faces))
    assert refused.value.field == "garment"


def test_a_garment_in_another_unit_than_its_body_is_refused():
    with pytest.raises(InvalidMesh, match="millimetres") as refused:
        Tracker(Mesh(1000 * TUBE.vertices, TUBE.faces), body=BODY)
    assert refused.value.field == "garment"


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_steps_of_another_unit_are_told(factor, unit):
    tracker = Tracker(TUBE)
    found = [tracker.step(cloud(0), timestamp=factor * k / FPS) for k in range(6)]
    assert "time_unit" in codes(found[-1])
    assert unit in found[-1].warnings[0].message
    assert codes(found[1]) <= {"clock_jump"}, "one long step is a gap"


@pytest.mark.parametrize("steps", [[1 / 30] * 9, [0.1] * 9, [1.0] * 9, *UNEVEN])
def test_usual_steps_and_gaps_are_no_sign(steps):
    tracker = Tracker(TUBE)
    for time in np.cumsum(steps):
        assert not tracker.step(cloud(0), timestamp=time).warnings


def test_a_clock_that_was_set_is_told_once():
    tracker = Tracker(TUBE)
    times = [0.0, 1 / FPS, *(1.7e9 + k / FPS for k in range(3))]
    found = [tracker.step(cloud(0), timestamp=time) for time in times]
    assert [codes(result) for result in found] == [set(), set(), {"clock_jump"}, set(), set()]
    assert "days" in found[2].warnings[0].message


def test_a_clock_that_hardly_advances_is_told():
    tracker = Tracker(TUBE)
    found = [tracker.step(cloud(0), timestamp=1e-5 * k) for k in range(6)]
    assert codes(found[-1]) == {"stale_clock"}
    assert "10 us" in found[-1].warnings[0].message


@pytest.mark.parametrize(("scale", "says"), [(0.92, "tracked in that size"), (0.6, "in another unit")])
def test_a_size_at_its_bound_is_not_said_to_be_followed(scale, says):
    tracker, said = Tracker(Mesh(scale * TUBE.vertices, TUBE.faces)), []
    tracker.reset(TUBE.vertices)
    for k in range(40):
        result = tracker.step(cloud(k), timestamp=k / FPS)
        said += [warning.message for warning in result.warnings if warning.code == "garment_size"]
    assert says in said[-1]

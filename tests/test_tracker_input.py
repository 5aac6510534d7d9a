"""Input of a tracker: refused arguments, and any finite input."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import Config, Mesh, Tracker
from ddakf.errors import FrameTooCostly, InvalidArgument, InvalidFrame, InvalidMesh
from ddakf.planning.clock import Clock
from tests.stages.scenes import FPS, inner_body, rms, scan, tube, turn
from tests.tracker_runs import (
    ACCELERATED,
    BODY,
    EYE,
    SAMPLE,
    SHIRT,
    TUBE,
    WEARER,
    assert_finite,
    assert_same,
    cloud,
    swaying,
    tracked,
)  # fmt: skip

# Bad input ----------------------------------------------------------------------------------------------------------

GOOD = cloud(4)
NAN = GOOD.copy()
NAN[17] = np.nan
REFUSED = [  # one of each field; tests/stages/test_frame_input.py has the others
    dict(points=NAN),
    dict(timestamp=1 / FPS),
    dict(sensor_origin=np.zeros((7, 3))),
    dict(body_vertices=BODY.vertices[:-1]),
]


def test_refused_frames_leave_the_tracker_as_it_was():
    tracker, twin = tracked(4, body=BODY), tracked(4, body=BODY)
    before = tracker.snapshot()
    frame = {"points": GOOD, "timestamp": 4 / FPS, "sensor_origin": EYE, "body_vertices": BODY.vertices}
    for bad in REFUSED:
        with pytest.raises(InvalidFrame) as refusal:
            tracker.step(**(frame | bad))
        assert refusal.value.field == next(iter(bad))
        assert "\n" not in str(refusal.value)
        assert tracker.snapshot() == before
    assert_same(tracker.step(**frame), twin.step(**frame))


@pytest.mark.parametrize("last", ["reliability.judge", "_result"])
def test_a_step_that_fails_at_its_end_leaves_the_tracker_as_it_was(monkeypatch, last):
    tracker, twin = tracked(4, body=BODY), tracked(4, body=BODY)
    before = tracker.snapshot()
    frame = {"points": GOOD, "timestamp": 4 / FPS, "sensor_origin": EYE, "body_vertices": BODY.vertices + 0.01}
    with monkeypatch.context() as broken:
        broken.setattr(f"ddakf.tracker.{last}", lambda *_: {}["memory"])
        with pytest.raises(KeyError):
            tracker.step(**frame)
    assert tracker.snapshot() == before
    assert_same(tracker.step(**frame), twin.step(**frame))


@pytest.mark.parametrize("last", ["predict", "fuse", "reliability"])
def test_a_frame_beyond_its_limit_leaves_the_tracker_as_it_was(monkeypatch, last):
    tracker, twin, stages = tracked(4, body=BODY), tracked(4, body=BODY), []
    before = tracker.snapshot()
    frame = {"points": GOOD, "timestamp": 4 / FPS, "sensor_origin": EYE, "body_vertices": BODY.vertices + 0.01}
    with monkeypatch.context() as slowed:
        slowed.setattr("ddakf.planning.clock.time.thread_time", lambda: float(stages.count(last)))
        slowed.setattr(Clock, "__call__", recording(stages))
        with pytest.raises(FrameTooCostly, match=f"up to {last}, 0.5 s are allowed"):
            tracker.step(**frame, limit=0.5)
    assert stages[-1] == last
    assert tracker.snapshot() == before
    assert_same(tracker.step(**frame, limit=60.0), twin.step(**frame))


def recording(stages: list[str]):
    """``Clock.__call__``, which also lists the stages."""
    timed = Clock.__call__

    def call(clock, stage):
        stages.append(stage)
        return timed(clock, stage)

    return call


def test_a_body_without_declaration_is_refused():
    tracker = tracked(2)
    before = tracker.snapshot()
    with pytest.raises(InvalidFrame, match="body_vertices: expected none"):
        tracker.step(GOOD, timestamp=1.0, body_vertices=BODY.vertices)
    assert tracker.snapshot() == before


@pytest.mark.parametrize(
    "how", [dict(vertices=TUBE.vertices[1:]), dict(vertices=np.full_like(TUBE.vertices, np.nan)), dict(velocities=[[0, 0]])],
    ids=["another size", "not finite", "velocities of another shape"],
)  # fmt: skip
def test_a_refused_reset_changes_nothing(how):
    tracker = tracked(2)
    before = tracker.snapshot()
    with pytest.raises(InvalidFrame) as refusal:
        tracker.reset(**how)
    assert refusal.value.field == next(iter(how))
    assert tracker.snapshot() == before


@pytest.mark.parametrize("garment", [None, TUBE.vertices, "mesh"], ids=["none", "vertices", "text"])
def test_what_is_no_mesh_is_refused(garment):
    with pytest.raises(InvalidMesh, match="garment: expected a ddakf"):
        Tracker(garment)
    if garment is not None:
        with pytest.raises(InvalidMesh, match="body: expected a ddakf"):
            Tracker(TUBE, body=garment)


@pytest.mark.parametrize(
    ("argument", "value"),
    [("limit", "x"), ("limit", float("nan")), ("limit", True), ("budget", True), ("budget", 0.0), ("budget", "1")],
)
def test_what_is_no_number_of_seconds_is_refused(argument, value):
    with pytest.raises(InvalidArgument, match=f"{argument}: expected processor seconds"):
        Tracker(TUBE).step(cloud(0), timestamp=0.0, **{argument: value})


def test_seconds_may_be_of_any_real_type():
    tracker = Tracker(TUBE)
    tracker.step(cloud(0), timestamp=np.float32(0.0), budget=np.float32(1.0), limit=np.float64(100.0))
    with pytest.raises(InvalidFrame, match="timestamp: expected seconds, got '1"):
        tracker.step(cloud(1), timestamp="1.5")


def test_integers_have_bounds_too():
    with pytest.raises(InvalidFrame, match="5 bad rows"):
        Tracker(TUBE).step(np.full((5, 3), np.iinfo(np.int64).min), timestamp=0.0)


def test_a_tracker_goes_on_from_trackers_alone():
    with pytest.raises(InvalidArgument, match="other: expected a ddakf"):
        Tracker(TUBE).continue_from("x")


@pytest.mark.parametrize("config", [{"predict": {}}, "paper", 3])
def test_what_is_no_configuration_is_refused(config):
    with pytest.raises(InvalidArgument):
        Tracker(TUBE, config=config)


@pytest.mark.parametrize("config", [Config(), ACCELERATED], ids=["default", "accelerated"])
def test_a_reset_starts_again_as_a_new_tracker_does(config):
    used, new = tracked(5, body=BODY, config=config), Tracker(TUBE, body=BODY, config=config)
    used.step(cloud(5), timestamp=5 / FPS, body_vertices=BODY.vertices + 0.2)
    moved, velocity = TUBE.vertices + 0.01, np.full(TUBE.vertices.shape, 0.1)
    for tracker in (used, new):
        tracker.reset(moved, velocities=velocity)
    for k in range(3):
        how = {"timestamp": k / FPS, "body_vertices": BODY.vertices}
        assert_same(used.step(cloud(k), **how), new.step(cloud(k), **how))


@pytest.mark.parametrize("away", [[0.0, 0.0, 0.0], [0.03, 0.0, 0.02], [2.0, 0.0, 0.0]])
def test_a_reset_in_between_finds_the_body_where_the_garment_is(away):
    """In its last pose, or, as where a recording begins again, in its first one."""
    tracker = Tracker(TUBE, body=BODY)
    tracker.reset(TUBE.vertices)
    for k in range(1, 4):
        shift = np.array(away) * k / 3
        points = (cloud(0) + shift).astype(np.float32)
        tracker.step(points, timestamp=k / FPS, sensor_origin=EYE + shift, body_vertices=BODY.vertices + shift)
    for place in (np.array(away), np.zeros(3)):
        tracker.reset(TUBE.vertices + place)
        np.testing.assert_allclose(tracker._track.body.vertices, BODY.vertices + place, atol=1e-12)


@pytest.mark.parametrize("degrees", [0, 180])
def test_a_reset_to_where_the_wearer_is_now_is_not_carried_there_again(degrees):
    """The body has moved since its last pose, of which a reset knows nothing."""
    start, worn = SAMPLE.garment_vertices.astype(float), SAMPLE.body_vertices.astype(float)
    middle = start[0].mean(axis=0)

    def moved(vertices):
        return (vertices - middle) @ turn(degrees).T + middle + [0.3, 0.0, 0.0]

    tracker = Tracker(SHIRT, body=WEARER)
    tracker.reset(start[0])
    tracker.step(scan(start[1], SHIRT), timestamp=1 / FPS, body_vertices=worn[1])
    tracker.reset(moved(start[1]))
    points, eye = scan(moved(start[2]), SHIRT), moved(middle + [0.0, 0.0, 3.0])
    seen = points[(points - moved(middle)) @ (eye - moved(middle)) > 0]
    result = tracker.step(seen, timestamp=5.0, sensor_origin=eye, body_vertices=moved(worn[2]))
    assert rms(result.vertices - moved(start[2])) < 0.01
    assert np.linalg.norm(result.velocities, axis=1).max() < 2.0


def test_where_the_body_was_before_the_first_frame_is_no_speed():
    """A template lies in its file's place, and its wearer stands three metres away."""
    away = np.array([3.0, 0.0, 0.0])
    tracker = Tracker(SHIRT, body=WEARER)
    for k in range(3):
        points = scan(SAMPLE.garment_vertices[0] + away, SHIRT, seed=k)
        pose = None if k == 1 else SAMPLE.body_vertices[0] + away
        result = tracker.step(points, timestamp=k / FPS, body_vertices=pose)
        assert rms(result.vertices - SAMPLE.garment_vertices[0] - away) < 0.01
        assert np.linalg.norm(result.velocities, axis=1).mean() < 1.0
        assert rms(tracker.predicted(result, 1 / FPS).vertices - result.vertices) < 0.03


# Any finite input ---------------------------------------------------------------------------------------------------

SMALL = tube(radius=0.1, around=12, along=6)
KINDS = {
    "uniform": lambda rng, n: rng.uniform(-0.4, 0.6, (n, 3)),
    "one point": lambda rng, n: np.tile(rng.uniform(-0.1, 0.1, (1, 3)), (n, 1)),
    "a line": lambda rng, n: rng.random((n, 1)) * [[0.1, 0.2, 0.1]],
    "a plane": lambda rng, n: rng.random((n, 3)) * [0.3, 0.3, 0.0],
    "on the vertices": lambda rng, n: SMALL.vertices[rng.integers(0, SMALL.n_vertices, n)],
    "huge": lambda rng, n: rng.uniform(-1e4, 1e4, (n, 3)),
    "tiny": lambda rng, n: 1e-30 * rng.normal(size=(n, 3)),
    "the garment": lambda rng, n: scan(SMALL.vertices, SMALL, n, 0.002, int(rng.integers(99))),
    "the garment, folded": lambda rng, n: scan(SMALL.vertices * [1, 1, 0.0], SMALL, n, 0.0, int(rng.integers(99))),
}
FRAMES = st.lists(
    st.tuples(
        st.sampled_from(list(KINDS)),
        st.sampled_from([0, 1, 2, 5, 50, 400]),
        st.sampled_from([1e-6, 1 / 240, 1 / 30, 0.7, 1e5]),
        st.sampled_from(["none", "one", "inside", "several"]),
        st.booleans(),
        st.integers(0, 2**32 - 1),
    ),
    min_size=1,
    max_size=5,
)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "paper"])
@given(frames=FRAMES)
@settings(max_examples=15, deadline=None, derandomize=True)
def test_finite_input_never_gives_anything_else(preset, frames):
    config = Config() if preset == "default" else Config.paper()
    body = inner_body(SMALL, 0.7)
    tracker, now = Tracker(SMALL, body=body, config=config), 0.0
    for kind, count, dt, origin, worn, seed in frames:
        rng, now = np.random.default_rng(seed), now + dt
        points = KINDS[kind](rng, count)
        several = rng.normal(size=(64, 3))[rng.integers(0, 64, count)]
        sensor = {"none": None, "one": EYE, "inside": SMALL.vertices[0], "several": several}[origin]
        pose = body.vertices + rng.normal(scale=0.02, size=(1, 3)) if worn else None
        try:
            result = tracker.step(points, timestamp=now, sensor_origin=sensor, body_vertices=pose)
        except InvalidFrame as refused:  # of another scale: a first cloud may have no size, or that of a house
            if "cloud of the garment" not in str(refused):
                raise
            continue
        assert_finite(result)
        assert (result.sigma > 0).all()
        assert np.linalg.eigvalsh(result.covariance).min() > 0
        assert np.abs(result.vertices).max() < 1e5


STAGES = ("start", "predict", "preprocess", "associate", "robust", "adapt", "physics", "fuse", "uncertainty")
WORN = inner_body(SMALL)
SCANS = [scan(SMALL.vertices, SMALL, count, 0.002, seed=k) for k, count in enumerate((400, 400, 0, 400))]


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_a_configuration_that_is_accepted_is_survived(stage):
    """Every number at either end of its range."""
    default, first = getattr(Config(), stage), Tracker(SMALL, body=WORN)
    for field in dataclasses.fields(default):
        for value in field.metadata.get("range", ()):
            changed = dataclasses.replace(default, **{field.name: int(value) if isinstance(field.default, int) else value})
            tracker = first.another(dataclasses.replace(Config(), **{stage: changed}))
            for k, points in enumerate(SCANS):
                result = tracker.step(points, timestamp=k / FPS, body_vertices=WORN.vertices)
                assert_finite(result)
                assert np.linalg.eigvalsh(result.covariance).min() > 0, f"{field.name} = {value}"


@pytest.mark.parametrize("gap", [1.0, 1e6, 1e11])
def test_any_later_time_gives_a_finite_result(gap):
    result = tracked(3).step(cloud(3), timestamp=gap)
    assert_finite(result)
    assert result.state == "tracking"


@pytest.mark.parametrize("dt", [1e-5, 1e-3])
def test_a_body_that_jumps_between_two_close_frames_gives_finite_results(dt):
    tracker = Tracker(TUBE, body=BODY)
    tracker.step(cloud(0), timestamp=0.0, body_vertices=BODY.vertices)
    assert_finite(tracker.step(cloud(1), timestamp=dt, body_vertices=BODY.vertices + 0.01))
    assert_finite(tracker.step(cloud(2), timestamp=1 / FPS))


@pytest.mark.parametrize("size", [1e-3, 1.0, 20.0])
def test_a_garment_of_any_size_gives_finite_results(size):
    tracker = Tracker(Mesh(TUBE.vertices * size, TUBE.faces))
    for k in range(2):
        assert_finite(tracker.step(size * cloud(k), timestamp=k / FPS))


def test_a_step_that_fails_inside_leaves_no_trace(monkeypatch):
    """Even of the body, which is the first thing that a step moves."""
    tracker = tracked(3, body=BODY)
    before = tracker.snapshot()
    with monkeypatch.context() as broken:
        broken.setattr("ddakf.tracker.reliability.judge", lambda *args: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            tracker.step(cloud(3), timestamp=1.0, body_vertices=BODY.vertices + 0.01)
    assert tracker.snapshot() == before


def test_a_body_in_the_wrong_place_for_one_frame_does_not_cost_the_track():
    tracker = tracked(3, body=BODY)
    tracker.step(cloud(3), timestamp=0.2, body_vertices=BODY.vertices + [3.0, 0.0, 0.0])
    for k in range(4, 30):
        result = tracker.step(cloud(k), timestamp=k / FPS + 0.2, body_vertices=BODY.vertices)
    assert_finite(result)
    assert result.state in ("tracking", "recovering")
    # a tube looks alike from every side: only its place can be found again
    assert np.linalg.norm(result.vertices.mean(axis=0) - swaying(29).mean(axis=0)) < 0.005

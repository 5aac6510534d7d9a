"""A track goes on by a tracker of another configuration, on a coarser or a finer working mesh."""

import weakref

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.config import Start
from ddakf.errors import InvalidArgument
from ddakf.evaluation.sensors import Sensor
from ddakf.physics import rigidity
from tests.stages.scenes import rms
from tests.tracker_runs import SAMPLE, SHIRT, TUBE, WEARER, assert_same

FIRST = 20  # frame of the sample
COARSE = Config().lighter()
VIEWS = pytest.mark.parametrize(("view", "body"), [("full", False), ("front", True)])


def frames(count, view, body, first=FIRST):
    """Arguments of so many frames, and the garment in them."""
    rng = np.random.default_rng(1)
    for k in range(first + 1, first + 1 + count):
        points, origin = Sensor(view=view, points=6000).capture(SAMPLE, k, rng)
        more = {"body_vertices": SAMPLE.body_vertices[k]} if body else {}
        yield points, {"timestamp": SAMPLE.timestamp(k), "sensor_origin": origin, **more}, SAMPLE.garment_vertices[k]


def started(body, config=None):
    under = Mesh(SAMPLE.body_vertices[FIRST], SAMPLE.body_faces) if body else None
    tracker = Tracker(SHIRT, body=under, config=config)
    tracker.reset(SAMPLE.garment_vertices[FIRST])
    return tracker


def tracked(body, view, count=6):
    tracker = started(body)
    for points, how, _ in frames(count, view, body):
        tracker.step(points, **how)
    return tracker


@VIEWS
def test_there_and_back_the_garment_stays_where_it_is(view, body):
    tracker = tracked(body, view)
    coarse = tracker.configured(COARSE)
    assert coarse.working_vertices < 0.8 * tracker.working_vertices
    again = coarse.configured(Config())
    for other, near in ((coarse, 0.004), (again, 0.004)):
        position = other._working.carried(other._track.state.position, other._track.rotation)
        assert rms(position - tracker._track.state.position) < near
    for name in ("P_pp", "P_uu", "R"):
        before, after = (np.trace(getattr(t._track.state, name), axis1=1, axis2=2).mean() for t in (tracker, again))
        assert 0.7 * before < after < 1.4 * before, name
        assert (np.linalg.eigvalsh(getattr(again._track.state, name)) > 0).all()
    before, after = (np.diagonal(t._track.drift.covariance).mean() for t in (tracker, again))
    assert 0.5 * before < after < 1.5 * before


def test_the_shape_at_rest_is_carried_over_once():
    """There and back in every frame, as for a checkpoint of a session with a lighter tracker."""
    own = started(body=False)
    coarse, first = own.configured(COARSE), own._track.resting
    kept = coarse._track.resting
    assert kept.edge.shape != first.edge.shape
    for _ in range(2):
        own.continue_from(coarse)
        coarse.continue_from(own)
        assert own._track.resting is first
        assert coarse._track.resting is kept
    learned = np.diag([0.1, 0.1, 0.1])
    coarse._track = coarse._track._replace(resting=rigidity.resize(kept, learned, coarse._setup))
    own.continue_from(coarse)
    np.testing.assert_array_equal(own._track.resting.size, learned, "a size that is learned meanwhile is kept")
    own.reset(SAMPLE.garment_vertices[FIRST + 1])
    coarse.continue_from(own)
    assert coarse._track.resting is not kept


def test_a_configuration_moves_what_it_decides_of_the_track_as_a_restore_does():
    """The axis that points upward decides whether a shirt lies on the shoulders."""
    side = started(body=True).configured(Config(start=Start(up="-y")))
    assert side._track.anchor.across is None
    again = side.configured(Config())
    assert again._track.anchor.across is not None
    assert Tracker.restore(again.snapshot())._track.anchor.across is not None


@VIEWS
def test_tracking_goes_on_through_changes_of_the_mesh(view, body):
    """About as close as by the mesh that is in use, and no less sure."""
    own, coarse, light = started(body), started(body, COARSE), False
    alone, changed, claims = [], [], []
    whole = started(body)
    for number, (points, how, truth) in enumerate(frames(24, view, body)):
        if number in (6, 18):
            coarse.continue_from(own)
            light = True
        if number == 12:
            own.continue_from(coarse)
            light = False
        result = (coarse if light else own).step(points, **how)
        assert result.state == "tracking"
        assert result.usage.working_vertices == (coarse if light else own).working_vertices
        changed.append(rms(result.vertices - truth))
        alone.append(rms(whole.step(points, **how).vertices - truth))
        claims.append(np.sqrt(3 * np.mean(result.sigma**2)) / changed[-1])
    assert np.mean(changed) < 1.5 * np.mean(alone)
    assert 0.4 < np.median(claims) < 5


def test_the_same_configuration_goes_on_exactly():
    tracker = tracked(True, "front")
    twin = started(True)
    twin.continue_from(tracker)
    for points, how, _ in frames(3, "front", True, first=FIRST + 6):
        assert_same(twin.step(points, **how), tracker.step(points, **how))


@VIEWS
def test_another_tracker_shares_what_is_constant_and_no_track(view, body):
    tracker, first = tracked(body, view), started(body)
    other, coarse = tracker.another(tracker.config), tracker.configured(COARSE)
    assert other._discretised is tracker._discretised
    assert other.another(COARSE)._discretised is coarse._discretised is started(body, COARSE)._discretised
    assert tracker._discretised is first._discretised is Tracker.restore(tracker.snapshot())._discretised
    assert not body or coarse._setup.body.tree is tracker._setup.body.tree
    assert coarse._working is not tracker._working is tracker.another(Config(start=Start(up="-y")))._working
    other.reset(SAMPLE.garment_vertices[FIRST])
    for points, how, _ in frames(3, view, body):
        assert_same(other.step(points, **how), first.step(points, **how))


def test_constants_that_no_tracker_has_are_given_up():
    tracker, known = Tracker(Mesh(1.01 * SHIRT.vertices, SHIRT.faces)), weakref.WeakSet()
    coarse = tracker.another(COARSE)
    known.update([tracker._discretised, coarse._discretised])
    del coarse
    assert set(known) == {tracker._discretised}


def test_a_tracker_of_another_garment_is_refused():
    with pytest.raises(InvalidArgument, match="same garment and body"):
        started(False).continue_from(Tracker(TUBE))
    with pytest.raises(InvalidArgument, match="same garment and body"):
        started(False).continue_from(Tracker(SHIRT, body=WEARER))


def test_a_lighter_configuration_keeps_what_was_chosen():
    own = Config.from_dict({"physics": {"stretch": 3e4}, "associate": {"wide_gate": 0.05}})
    light = own.lighter()
    assert (light.physics, light.associate) == (own.physics, own.associate)
    assert light.discretisation.working_edge > own.discretisation.working_edge
    assert light.preprocess == Config.fast().preprocess
    assert light.lighter() == light
    assert Config.paper().lighter() == Config.paper()


@pytest.mark.parametrize("body", [False, True])
def test_colours_of_other_things_are_carried_over_as_counts(body):
    """The shares of a place on another mesh may be -1e-17."""
    tracker, rng = started(body), np.random.default_rng(2)
    for k in range(FIRST + 1, FIRST + 6):
        cloth, skin = SAMPLE.garment_vertices[k], SAMPLE.body_vertices[k][::3]
        colors = np.repeat([[200, 30, 30], [220, 180, 150]], [len(cloth), len(skin)], axis=0) + rng.integers(-8, 8, (1, 3))
        more = {"body_vertices": SAMPLE.body_vertices[k]} if body else {}
        tracker.step(np.concatenate([cloth, skin]), timestamp=SAMPLE.timestamp(k), colors=colors.astype(np.uint8), **more)
    for other in (tracker.configured(COARSE), tracker.configured(COARSE).configured(Config())):
        assert min(other._track.palette.seen.min(), other._track.palette.alike.min()) >= 0
        assert Tracker.restore(other.snapshot()).timestamp == tracker.timestamp

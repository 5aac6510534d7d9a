"""The lighter tracker of a session goes on where its own one is, and back."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.workers.compute.session_tracker import SessionTracker
from ddakf_service.workers.compute.tracker_host import TrackerHost
from ddakf_service.workers.messages import wire
from ddakf_service.workers.pool import Limits

from ddakf import Config, Tracker
from tests.service.conftest import frame_of
from tests.stages.scenes import FPS
from tests.tracker_runs import EYE, SHIRT, TUBE, cloud


def waiting(session):
    """The session, its lighter tracker built."""
    session.of_frame(True)
    session._lighter.result(timeout=60)
    return session


@pytest.fixture
def builder():
    with ThreadPoolExecutor(1) as pool:
        yield pool


def test_frames_go_on_while_the_lighter_tracker_is_built(builder):
    own = Tracker(SHIRT)
    session = SessionTracker(own, builder)
    builder.submit(lambda: None).result()
    assert session.of_frame(True) is own
    assert not session.is_lighter
    lighter = waiting(session).of_frame(True)
    assert lighter.working_vertices < own.working_vertices
    assert session.is_lighter


@pytest.mark.parametrize(("config", "has"), [(Config(), True), (Config.fast(), False)])
def test_whether_there_is_a_lighter_tracker_is_known_once_it_is_wanted(builder, config, has):
    session = SessionTracker(Tracker(TUBE, config=config), builder)
    assert session.has_lighter
    assert waiting(session).has_lighter is has


def test_the_session_is_one_track(builder):
    session = SessionTracker(Tracker(SHIRT), builder)
    waiting(session)
    places = [SHIRT.vertices + [0.01 * k, 0.0, 0.0] for k in range(9)]
    for k, place in enumerate(places):
        tracker = session.of_frame(2 < k < 6)
        result = tracker.step(place.astype(np.float32), timestamp=k / FPS)
        assert np.linalg.norm(result.vertices - place, axis=1).mean() < 0.006
    assert not session.is_lighter


def test_its_own_tracker_is_where_the_lighter_one_is(builder):
    own = Tracker(SHIRT)
    session = SessionTracker(own, builder)
    waiting(session).of_frame(True).step((SHIRT.vertices + [0.05, 0.0, 0.0]).astype(np.float32), timestamp=1.0)
    restored = Tracker.restore(session.own().snapshot())
    assert restored.config == own.config
    assert restored._track.time == 1.0
    assert not session.is_lighter


def test_a_checkpoint_is_of_its_own_tracker_and_the_lighter_one_goes_on():
    """A checkpoint every second must not cost frames, when there are sessions that have lighter trackers for want of time."""
    host = host_of(one=SHIRT)
    session = waiting(host._trackers["one"])
    lighter = session.of_frame(True)
    lighter.step((SHIRT.vertices + [0.05, 0.0, 0.0]).astype(np.float32), timestamp=1.0)
    before = lighter.snapshot()
    restored = Tracker.restore(host.snapshot("one", b""))
    assert (restored.config, restored._track.time) == (Config(), 1.0)
    assert session.of_frame(True) is lighter
    assert lighter.snapshot() == before


@pytest.mark.parametrize("config", [Config.paper(), Config.fast()], ids=["paper", "fast"])
def test_some_configurations_have_no_lighter_one(config, builder):
    own = Tracker(TUBE, config=config)
    session = SessionTracker(own, builder)
    assert waiting(session).of_frame(True) is own
    assert own.step(cloud(0), timestamp=0.0, sensor_origin=EYE).state


def host_of(**garments) -> TrackerHost:
    """A worker with sessions by name, each of a garment."""
    host = TrackerHost(Limits(max_points=5_000, max_vertices=5_000, max_faces=10_000, max_body_vertices=0, max_image_pixels=1))
    for name, garment in garments.items():
        session = pb.Session(garment=pack_mesh(garment.vertices, garment.faces))
        host.open(name, pb.CreateSessionRequest(api_version=API_VERSION, session=session).SerializeToString())
    return host


def test_sessions_of_one_garment_share_its_constants_and_no_track():
    host = host_of(one=SHIRT, two=SHIRT, three=TUBE)
    host.frame("two", wire.frame_request_head(b"", 5_000, wire.WHOLE) + frame_of(SHIRT, 1).SerializeToString())
    host.restore("four", pb.RestoreSessionRequest(data=host.snapshot("two", b"")).SerializeToString())
    one, two, three, four = (host._trackers[name].own() for name in ("one", "two", "three", "four"))
    assert one._discretised is two._discretised is four._discretised is not three._discretised
    assert (one._track.time, four._track.time) == (None, two._track.time)
    assert np.array_equal(four._track.state.position, two._track.state.position)


def test_lighter_trackers_are_built_as_soon_as_there_are_several_sessions():
    alone, beside = host_of(one=SHIRT), host_of(one=SHIRT, two=TUBE)
    assert alone._trackers["one"]._lighter is None
    for session in beside._trackers.values():
        assert session._lighter.result(timeout=60).config == Config().lighter()


def test_who_waits_for_the_lighter_tracker_has_it(builder):
    session = SessionTracker(Tracker(SHIRT), builder)
    session.await_lighter(60.0)  # nothing is being built
    session.prepare()
    session.await_lighter(60.0)
    assert session._lighter.done()


def test_a_frame_is_tracked_as_its_grant_says():
    host = host_of(one=SHIRT)
    waiting(host._trackers["one"])

    def answer(number, grant):
        frame = frame_of(SHIRT, number).SerializeToString()
        content = host.frame("one", wire.frame_request_head(b"", 5_000, grant) + frame)
        return pb.Result.FromString(wire.unpack_result(content)[0]).usage, wire.unpack_spent(content)

    own, _ = answer(1, wire.WHOLE)
    lighter, spent = answer(2, wire.Grant(0.05, True))
    again, _ = answer(3, wire.Grant(0.05, False))
    assert (own.lighter, lighter.lighter, again.lighter) == (False, True, False)
    assert (spent.lighter, lighter.budget_seconds) == (True, 0.05)
    assert lighter.working_vertices < own.working_vertices == again.working_vertices == SHIRT.n_vertices

"""Expiry: idle sessions, sessions left by their client, sessions at the end of their lifetime."""

from __future__ import annotations

import asyncio
import itertools
import math
import time

import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import SessionExpired, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.auth.principal import Principal, Scope, current_principal
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions import lifecycle, service
from ddakf_service.sessions.recovery import tracker_access
from ddakf_service.sessions.session import Session
from ddakf_service.settings import Settings
from ddakf_service.store.clock import clock
from ddakf_service.store.store import Store

from ..conftest import TIMEOUT, Talk, eventually, frame_of, held, request_of, workers

pytestmark = pytest.mark.slow


def why(api, name: str) -> str:
    """Reason of a session's expiry; empty while it is live."""
    try:
        api.get(name)
    except SessionExpired as error:
        return str(error)
    return ""


@pytest.mark.parametrize("seconds", [1e9, 1e12, math.inf])
def test_a_server_may_let_sessions_wait_for_ever(seconds):
    limits = pb.SessionLimits(idle_timeout=seconds, departure_timeout=seconds)
    message = Session("shirt", pb.Session(), pb.Session(), limits).message()
    assert message.HasField("expire_time") == (seconds < 1e12), "which no date says"


def test_an_idle_session_expires(api, http, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(idle_timeout=0.5)).name
    assert "0.5 s" in eventually(lambda: why(api, name))
    answer = http.get(f"/v1/{name}")
    assert (answer.status_code, answer.json()["error"]["name"]) == (410, "SessionExpired")


def test_a_session_that_its_client_has_left_waits_and_expires(api, sheet):
    """The departure timeout does not run while a stream is open, or before the first one."""
    limits = pb.SessionLimits(departure_timeout=2)
    left, waiting, open_still = (api.create(sheet, limits=limits).name for _ in range(3))
    talk = Talk(api, open_still)
    list(api.track(left, [request_of(frame_of(sheet, 1))]))
    again = list(api.track(left, [request_of(frame_of(sheet, 2))]))
    assert again[0].started.last_sequence_number == 1, "within the window it comes back to what it left"
    assert "did not return within 2 s" in eventually(lambda: why(api, left))
    assert [api.get(name).name for name in (waiting, open_still)] == [waiting, open_still]
    talk.end()
    assert eventually(lambda: why(api, open_still))
    api.delete(waiting)


def test_a_lifetime_ends_even_a_busy_session(api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(max_lifetime=1.0)).name

    def endless():
        for number in itertools.count(1):
            time.sleep(0.05)
            yield request_of(frame_of(sheet, number))

    with pytest.raises(SessionExpired, match="its lifetime of 1 s"):
        list(api.track(name, endless()))
    assert "its lifetime" in why(api, name)


def test_a_client_whose_frames_are_all_refused_is_there_still(api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(idle_timeout=2)).name

    def bad_frames():
        for number in range(1, 10):
            time.sleep(0.3)
            yield pb.TrackRequest(frame=pb.Frame(sequence_number=number, point_cloud=pb.PointCloud(point_count=3)))

    responses = list(api.track(name, bad_frames()))
    assert [response.HasField("frame_error") for response in responses[1:]] == [True] * 9
    api.delete(name)


def test_a_session_whose_frame_waits_for_its_worker_is_in_use(service, api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(idle_timeout=0.5)).name
    with Talk(api, name) as talk:
        with held(workers(service.pid)):
            talk.send(frame_of(sheet, 1))
            time.sleep(3.0)  # looks for expired sessions
        kinds = [next(talk.answers).WhichOneof("message") for _ in range(2)]
        assert kinds == ["notice", "result"]
    api.delete(name)


class Pool:
    """Opens sessions at once, and cannot close them where ``fails``; ``full``: it has no worker for a restore."""

    def __init__(self, fails=False, full=False):
        self.fails, self.full = fails, full

    async def open(self, session_id, request, memory):
        if self.full:
            raise Unavailable("no worker")
        return pb.Session(name=session_id).SerializeToString()

    restore = open

    def count_memory(self, session_id, memory):
        pass

    async def snapshot(self, session_id, compressed=False):
        return b""

    async def close(self, session_id):
        if self.fails:
            raise RuntimeError("no")


@pytest.fixture
def sessions_of(request):
    """Makes the sessions of a server with a pool."""

    def make(pool: Pool, **settings) -> service.Sessions:
        settings, metrics = Settings(**{"data_dir": "none", **settings}), Metrics()
        store = Store(settings, metrics)
        request.addfinalizer(store.close)
        return service.Sessions(pool, settings, metrics, store)

    return make


@pytest.mark.parametrize("hours", [-10, 10])
def test_a_clock_that_is_set_changes_no_lifetime(monkeypatch, hours):
    session = Session("one", pb.Session(), pb.Session(), pb.SessionLimits(max_lifetime=100.0, idle_timeout=1e6))
    before, _ = session.expiry()
    monkeypatch.setattr(clock, "_ahead", 3600.0 * hours)
    assert session.expiry()[0] == before


async def test_the_requests_of_a_key_forget_none_of_another(monkeypatch, sessions_of):
    monkeypatch.setattr(lifecycle, "_MAX_REQUESTS", 2)
    server = sessions_of(Pool())

    async def create(key: str, request_id: str) -> str:
        current_principal.set(Principal(key, frozenset({Scope.STREAM})))
        return (await server.create(pb.CreateSessionRequest(api_version=API_VERSION, request_id=request_id))).name

    first = [await create("one", "a"), await create("two", "a")]
    for request_id in "bcd":
        await create("two", request_id)
    assert await create("one", "a") == first[0]
    assert await create("two", "a") != first[1], "the oldest of its own"


async def created(server: service.Sessions, name: str) -> Session:
    await server.create(pb.CreateSessionRequest(api_version=API_VERSION, session_id=name))
    return server._catalog.readable(f"sessions/{name}")


async def test_one_session_that_cannot_be_closed_keeps_no_other_from_expiring(monkeypatch, sessions_of):
    """A worker that fails at the end of a session."""
    monkeypatch.setattr(service, "_EXPIRY_INTERVAL", 0.01)
    mine = sessions_of(Pool(fails=True))
    for name in ("first", "other"):
        (await created(mine, name)).last_active -= 1e6
    expiry = asyncio.create_task(mine.expire_idle())
    async with asyncio.timeout(TIMEOUT):
        while len(mine._catalog):
            assert not expiry.done()
            await asyncio.sleep(0.01)
    expiry.cancel()
    for name in ("first", "other"):
        with pytest.raises(SessionExpired):
            await mine.get(f"sessions/{name}")


async def test_a_slow_start_takes_nothing_of_the_time_that_a_client_has_to_return(monkeypatch, tmp_path, sessions_of):
    """The earlier sessions are loaded before the workers compile their kernels, which may take minutes."""
    before = sessions_of(Pool(), data_dir=str(tmp_path))
    await created(before, "some")
    await before.drain(0.0)
    await asyncio.to_thread(before._store.close)
    looked = asyncio.Event()
    after = sessions_of(Pool(), data_dir=str(tmp_path))
    await after.load()
    session = after._catalog.readable("sessions/some")
    session.departure_time -= 1e6
    session.last_active -= 1e6
    monkeypatch.setattr(service, "_EXPIRY_INTERVAL", 0.0)
    monkeypatch.setattr(after._persistence, "save", lambda session: looked.set())
    expiry = asyncio.create_task(after.expire_idle())
    await asyncio.wait_for(looked.wait(), TIMEOUT)
    expiry.cancel()
    assert (await after.get("sessions/some")).name == "sessions/some"


async def test_a_client_whose_session_finds_no_worker_has_returned(monkeypatch, sessions_of):
    monkeypatch.setattr(tracker_access, "_WORKER_TIMEOUT", 0.0)
    pool = Pool()
    mine = sessions_of(pool)
    session = await created(mine, "some")
    session.has_worker, pool.full = False, True
    session.last_active -= 1e6
    with pytest.raises(Unavailable):
        await mine.reset(pb.ResetSessionRequest(name=session.name))
    assert session.idle_for < 1e3
    await mine.delete(session.name)

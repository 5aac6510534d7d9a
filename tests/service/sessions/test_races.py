"""Concurrent events of a session, with a small fake pool; everything else is the service's."""

from __future__ import annotations

import asyncio
import gc
import weakref

import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import (
    Draining,
    ResourceExhausted,
    SessionExpired,
    SessionNotFound,
    StreamTakenOver,
    Unavailable,
    WorkerLost,
)
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.metrics import Metrics
from ddakf_service.observability.tracing import NoTracer
from ddakf_service.sessions import lifecycle, service
from ddakf_service.sessions.recovery.tenure import Tenure
from ddakf_service.sessions.sharing.handover import Handover
from ddakf_service.settings import Settings
from ddakf_service.store.store import Store
from ddakf_service.streaming.frame_message import FrameMessage
from ddakf_service.streaming.frame_recorder import FrameRecorder
from ddakf_service.streaming.streams import Streams
from ddakf_service.transports.rest.routes import create_app

START = pb.Start(name="sessions/some", api_version=API_VERSION)


class Pool:
    """Records opened and closed sessions; ``busy`` blocks calls of a session."""

    def __init__(self):
        self.calls, self.counted = [], None
        self.busy, self.configuring = asyncio.Event(), asyncio.Event()
        self.lost = self.full = False

    async def open(self, session_id, request, memory):
        self.calls.append(("open", session_id))
        return pb.Session().SerializeToString()

    async def restore(self, session_id, request, memory):
        self.calls.append(("restore", session_id))
        if self.full:
            raise ResourceExhausted("memory")
        return pb.Session().SerializeToString()

    import_snapshot = restore

    def count_memory(self, session_id, memory):
        if self.full:
            raise ResourceExhausted("memory")
        self.counted = memory

    async def configure(self, session_id, request):
        self.configuring.set()
        await self.busy.wait()
        return pb.UpdateSessionRequest.FromString(request).session.SerializeToString()

    async def snapshot(self, session_id, compressed=False):
        if self.lost:
            raise WorkerLost("lost")
        return b""

    async def reset(self, session_id, request):
        self.lost = True  # right after it

    async def close(self, session_id):
        self.calls.append(("close", session_id))


@pytest.fixture
async def pool():
    return Pool()


@pytest.fixture
async def store():
    store = Store(Settings(data_dir="none"), Metrics())
    yield store
    await asyncio.to_thread(store.close)


@pytest.fixture
async def server(pool, store):
    """The sessions of a server, with one session: "some"."""
    server = service.Sessions(pool, Settings(data_dir="none"), Metrics(), store)
    await server.load()
    await create(server)
    return server


@pytest.fixture
async def streams(server, store):
    return Streams(server.components, FrameRecorder(Metrics(), store.history, NoTracer()))


async def create(server) -> None:
    await server.create(pb.CreateSessionRequest(api_version=API_VERSION, session_id="some"))


async def test_nothing_is_kept_of_a_session_that_ended_under_its_stream(server, streams):
    session = weakref.ref(server._catalog.readable("sessions/some"))

    async def serve() -> None:
        stream = await streams.open(START)
        opened.set()
        try:
            await stream.deliver(lambda response: asyncio.sleep(0))
        finally:
            await streams.leave(stream)

    opened = asyncio.Event()
    serving = asyncio.create_task(serve())
    await opened.wait()
    await server.delete("sessions/some")
    with pytest.raises(SessionNotFound, match="was deleted"):
        await serving
    del serving
    await server._tasks.settle(1.0)
    for _ in range(100):  # callbacks of what has ended, of threads too
        gc.collect()
        if session() is None:
            break
        await asyncio.sleep(0.05)
    assert session() is None


async def test_a_worker_forgets_a_session_whose_deletion_was_cut_off(server, pool):
    session = server._catalog.readable("sessions/some")
    async with session.lock:  # a frame is in the worker
        deletion = asyncio.create_task(server.delete("sessions/some"))
        await asyncio.sleep(0)
        deletion.cancel()
        await asyncio.wait({deletion})
    await server._tasks.settle(1.0)
    assert pool.calls == [("open", "some"), ("close", "some")]


async def test_an_id_is_free_once_the_worker_has_forgotten_it(server, pool):
    async with server._catalog.readable("sessions/some").lock:
        deletion = asyncio.create_task(server.delete("sessions/some"))
        await asyncio.sleep(0)
        creation = asyncio.create_task(create(server))
        await asyncio.sleep(0)
    await asyncio.gather(deletion, creation)
    assert pool.calls == [("open", "some"), ("close", "some"), ("open", "some")]


async def test_sessions_that_are_created_at_a_time_keep_the_limit_of_the_server(pool, store):
    server = service.Sessions(pool, Settings(data_dir="none", max_sessions=3), Metrics(), store)
    await server.load()
    request = pb.CreateSessionRequest(api_version=API_VERSION)
    done = await asyncio.gather(*(server.create(request) for _ in range(8)), return_exceptions=True)
    created = [session.name for session in done if isinstance(session, pb.Session)]
    refused = [str(error) for error in done if isinstance(error, ResourceExhausted)]
    assert (len(created), len(refused), len(pool.calls)) == (3, 5, 3)
    assert {reason.partition(";")[0] for reason in refused} == {"sessions: the server has its 3 already"}
    await server.delete(created[0])
    await server.create(request)


async def test_a_session_that_ended_while_it_was_updated_stays_ended(server, pool, store):
    session = server._catalog.readable("sessions/some")
    change = pb.Session(name="sessions/some", fabric="denim")
    update = asyncio.create_task(server.update(pb.UpdateSessionRequest(session=change)))
    await pool.configuring.wait()
    deletion = asyncio.create_task(server.delete("sessions/some"))
    await asyncio.sleep(0)
    pool.busy.set()
    await asyncio.gather(update, deletion)
    assert (await store.registry.newest("some")).reason.name == "SessionNotFound"
    assert session.uid not in server._persistence._saved


async def test_a_stop_does_not_wait_for_a_session_on_its_way_back(server, monkeypatch):
    monkeypatch.setattr(service, "_LAST_CHECKPOINTS_TIMEOUT", 0.05)
    async with server._catalog.readable("sessions/some").lock:
        await asyncio.wait_for(server.drain(0.0), 30.0)


async def test_a_server_that_stops_opens_no_stream(server, streams):
    server._admission.draining = True
    with pytest.raises(Draining):
        await streams.open(START)


async def test_of_takeovers_at_a_time_the_last_one_wins_and_none_is_refused(server, streams):
    takeover = pb.Start(name="sessions/some", api_version=API_VERSION, takeover=True)
    first = await streams.open(START)
    opened = await asyncio.gather(*(streams.open(takeover) for _ in range(4)))
    assert server._catalog.readable("sessions/some").stream is opened[-1]
    for stream in (first, *opened[:-1]):
        with pytest.raises(StreamTakenOver):
            await stream.deliver(lambda response: asyncio.sleep(0))
    assert not opened[-1].ending.is_set()
    await streams.leave(opened[-1])


async def test_before_the_register_is_read_nobody_is_told_that_a_session_does_not_exist(server, streams):
    server._catalog.loaded = False
    with pytest.raises(Unavailable, match="not known before the database can be read"):
        await streams.open(pb.Start(name="sessions/earlier", api_version=API_VERSION))


async def test_a_session_that_is_created_while_the_database_is_away_replaces_the_stored_one(server, pool, store, monkeypatch):
    await server._persistence.written(server._catalog.readable("sessions/some").uid)
    monkeypatch.setattr(lifecycle, "LOAD_RETRY_INTERVAL", 0.01)
    after = service.Sessions(pool, Settings(data_dir="none"), Metrics(), store)
    stored, back = after._persistence.live_sessions, asyncio.Event()

    async def live_sessions():
        if not back.is_set():
            raise Unavailable("no database")
        return await stored()

    monkeypatch.setattr(after._persistence, "live_sessions", live_sessions)
    await after.load()
    await create(after)
    back.set()
    while not after._catalog.loaded:
        await asyncio.sleep(0.01)
    uid = after._catalog.readable("sessions/some").uid
    async with asyncio.timeout(10):
        while [session.uid for session in await stored()] != [uid]:
            await asyncio.sleep(0.01)


async def test_answers_are_kept_for_as_many_frames_as_the_stream_was_told(server, streams):
    stream = await streams.open(pb.Start(name="sessions/some", api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS))
    session = server._catalog.readable("sessions/some")
    most = session.limits.max_frames_in_flight
    await server.update(pb.UpdateSessionRequest(session=pb.Session(name="sessions/some", limits={"max_frames_in_flight": 1})))
    for number in range(1, most + 1):
        await stream.receive(FrameMessage.of(pb.Frame(sequence_number=number, deadline=-1.0)))  # refused
    delivered = []

    async def deliver(response):
        delivered.append(response)

    delivering = asyncio.create_task(stream.deliver(deliver))
    async with asyncio.timeout(10):
        while len(delivered) < 1 + most:  # Started first
            await asyncio.sleep(0.01)
    assert len(session.answers.serialised()) == most > 1
    await streams.leave(stream)
    delivering.cancel()


async def test_every_call_gives_the_reason_of_a_session_that_ended_before_a_restart(server, pool, store):
    session = server._catalog.readable("sessions/some")
    server._lifecycle.end(session, SessionExpired("it was left"))
    await server._persistence.written(session.uid)
    again = service.Sessions(pool, Settings(data_dir="none"), Metrics(), store)
    await again.load()
    streams = Streams(again.components, FrameRecorder(Metrics(), store.history, NoTracer()))
    watch = pb.WatchSessionRequest(name="sessions/some", api_version=API_VERSION)
    calls = again.get("sessions/some"), streams.open(START), streams.watch(watch)
    errors = await asyncio.gather(*calls, return_exceptions=True)
    assert [(type(error), str(error)) for error in errors] == [(SessionExpired, "it was left")] * 3


async def test_a_reset_is_answered_once_a_lost_worker_does_not_undo_it(server):
    with pytest.raises(WorkerLost):
        await server.reset(pb.ResetSessionRequest(name="sessions/some"))


async def test_two_updates_at_a_time_keep_what_each_has_changed(server, pool):
    first = pb.Session(name="sessions/some", labels={"whose": "first"}, fabric="silk")
    second = pb.Session(name="sessions/some", limits=pb.SessionLimits(max_points=7))
    calls = [asyncio.create_task(server.update(pb.UpdateSessionRequest(session=change))) for change in (first, second)]
    await pool.configuring.wait()
    pool.busy.set()
    await asyncio.gather(*calls)
    after = await server.get("sessions/some")
    assert (dict(after.labels), after.limits.max_points) == ({"whose": "first"}, 7)


@pytest.mark.parametrize(("match", "statuses"), [("*", [200, 200]), ('"1"', [200, 412])])
async def test_the_etag_that_if_match_compares_is_the_one_of_the_moment_of_the_change(
    server, pool, store, monkeypatch, match, statuses
):
    obtain, arrivals = server._ownership.obtain, asyncio.Semaphore(0)

    async def arriving(name):
        session = await obtain(name)
        arrivals.release()
        return session

    monkeypatch.setattr(server._ownership, "obtain", arriving)
    app = create_app(server, Settings(data_dir="none"), Metrics(), lambda: "", store)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://service") as http:
        changes = {"fabric": "silk"}, {"labels": {"a": "b"}}
        calls = asyncio.gather(*(http.patch("/v1/sessions/some", json=body, headers={"If-Match": match}) for body in changes))
        for _ in changes:
            await arrivals.acquire()
        pool.busy.set()
        answers = await calls
    assert sorted(answer.status_code for answer in answers) == statuses
    assert (await server.get("sessions/some")).etag == str(1 + statuses.count(200))


async def left(call: asyncio.Task, pool: Pool) -> None:
    """The caller leaves while the worker carries out the call, whose session nobody else may change meanwhile."""
    await pool.configuring.wait()
    call.cancel()
    await asyncio.sleep(0)
    assert not call.done()
    pool.busy.set()
    with pytest.raises(asyncio.CancelledError):
        await call


async def test_an_update_whose_client_leaves_is_recorded(server, pool, store):
    session = server._catalog.readable("sessions/some")
    await server._tasks.settle(1.0)
    checkpoints, etag = session.checkpoint_number, str(session.revision)
    change = pb.Session(name="sessions/some", fabric="silk", limits=pb.SessionLimits(max_points=7))
    await left(asyncio.create_task(server.update(pb.UpdateSessionRequest(session=change))), pool)
    after = await server.get("sessions/some")
    assert (after.fabric, after.limits.max_points, pool.counted) == ("silk", 7, session.memory)
    assert (after.etag != etag, session.checkpoint_number) == (True, checkpoints + 1)
    assert await server._persistence.written(session.uid)
    assert (await store.registry.newest("some")).session.fabric == "silk"


async def test_a_reset_whose_client_leaves_is_recorded(server, pool, monkeypatch):
    async def reset(session_id, request):
        pool.configuring.set()
        await pool.busy.wait()

    session, request = server._catalog.readable("sessions/some"), pb.ResetSessionRequest(name="sessions/some")
    await server._tasks.settle(1.0)
    checkpoints = session.checkpoint_number
    monkeypatch.setattr(pool, "reset", reset)
    await left(asyncio.create_task(server.reset(request)), pool)
    assert (session.last_reset, session.checkpoint_number) == (request.SerializeToString(), checkpoints + 1)


@pytest.mark.parametrize("change", ["reset", "update"])
async def test_no_reader_learns_of_a_change_that_is_lost_with_its_worker(server, streams, pool, change):
    watcher = await streams.watch(pb.WatchSessionRequest(name="sessions/some", api_version=API_VERSION, include_frames=True))
    session = server._catalog.readable("sessions/some")
    pool.lost = True
    pool.busy.set()
    requests = {
        "reset": lambda: server.reset(pb.ResetSessionRequest(name="sessions/some")),
        "update": lambda: server.update(pb.UpdateSessionRequest(session=pb.Session(name="sessions/some", fabric="silk"))),
    }
    with pytest.raises(WorkerLost):
        await requests[change]()
    watcher.close(None)
    assert [response.message.WhichOneof("message") async for response in watcher.responses()] == ["started"]
    assert session.last_reset == b""


async def test_an_update_that_fails_by_a_defect_counts_the_memory_of_before(server, pool, monkeypatch):
    async def configure(session_id, request):
        raise RuntimeError("no")

    session = server._catalog.readable("sessions/some")
    monkeypatch.setattr(pool, "configure", configure)
    change = pb.Session(name="sessions/some", fabric="silk", limits=pb.SessionLimits(max_points=7))
    with pytest.raises(RuntimeError):
        await server.update(pb.UpdateSessionRequest(session=change))
    assert pool.counted == session.memory


async def test_a_session_waits_for_a_worker_with_room(server, pool):
    """Other sessions use the memory until the lost worker is replaced."""
    session = server._catalog.readable("sessions/some")
    await server._durability.checkpoint_now(session)
    pool.full = True
    server.lose(["some"])
    while ("restore", "some") not in pool.calls:
        await asyncio.sleep(0)
    pool.full = False
    async with asyncio.timeout(60):
        while not session.has_worker:
            await asyncio.sleep(0.01)
    assert server._catalog.readable("sessions/some") is session


class NoLeases:
    """Leases that nobody else has."""

    def __init__(self):
        self.released = []

    async def claim(self, session_id, uid, owner, request_id, require_room):
        return 1

    async def of_request(self, owner, request_id):
        return None

    async def release(self, uid, epoch):
        self.released.append(uid)


async def test_a_session_that_waits_for_a_worker_goes_to_another_server(server, pool):
    session, leases = server._catalog.readable("sessions/some"), NoLeases()
    await server._durability.checkpoint_now(session)
    pool.full = True
    server.lose(["some"])
    while ("restore", "some") not in pool.calls:
        await asyncio.sleep(0)
    of_session = server._catalog, server._persistence, server._durability, server._tasks, server._lifecycle.depart
    handover = Handover(leases, *of_session, Tenure(), Metrics())
    await asyncio.wait_for(handover.hand_over(session, StreamTakenOver("elsewhere")), 30.0)
    assert leases.released == [session.uid]
    assert session.closed


async def test_two_calls_of_one_request_id_make_one_session_where_servers_share_them(server, pool, monkeypatch):
    async def created_by(owner, request_id):
        await asyncio.sleep(0.01)

    monkeypatch.setattr(server._lifecycle, "_leases", NoLeases())
    monkeypatch.setattr(server._persistence, "created_by", created_by)
    request = pb.CreateSessionRequest(api_version=API_VERSION, request_id="the same")
    first, second = await asyncio.gather(server.create(request), server.create(request))
    assert first.name == second.name
    assert len(pool.calls) == 2  # with "some"


async def test_a_session_that_needs_more_memory_than_there_is_is_closed_again(server, pool):
    """Of a snapshot it is known only afterwards."""
    pool.full = True
    request = pb.CreateSessionRequest(api_version=API_VERSION, session_id="large")
    with pytest.raises(ResourceExhausted):
        await server.create(request)
    assert pool.calls[-2:] == [("open", "large"), ("close", "large")]
    pool.full = False
    await server.create(request)


async def test_limits_that_need_more_memory_than_there_is_are_refused(server, pool):
    before, pool.full = server._catalog.readable("sessions/some").limits, True
    limits = pb.SessionLimits(max_points=500_000)
    change = pb.Session(name="sessions/some", limits=limits, labels={"a": "b"}, fabric="silk")
    with pytest.raises(ResourceExhausted):
        await server.update(pb.UpdateSessionRequest(session=change))
    assert server._catalog.readable("sessions/some").limits == before
    assert not server._catalog.readable("sessions/some").labels
    assert not pool.configuring.is_set()

"""What can be done with the sessions of a server, from creation to end. Every transport speaks to this class alone."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence, Set
from time import monotonic

from ddakf_api.errors import (
    Draining,
    FailedPrecondition,
    InvalidArgument,
    ServiceError,
    SessionBusy,
    SessionExists,
    SessionNotFound,
    StreamTakenOver,
    Unavailable,
    WorkerLost,
)
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.version import require_compatible

from . import admission
from .admission import Admission
from .directory import LOAD_PAUSE, Directory, not_found, revoked
from .durability import Durability, taken_meshes
from .outcomes import Outcomes
from .records import Records
from .session import Session
from .settings import Settings
from .store import Store
from .stream import Stream
from .telemetry import Metrics
from .tracing import Tracer
from .trust.principal import Principal, current_principal
from .watch import Watcher
from .workers import Memory, WorkerPool

log = logging.getLogger(__name__)

_Open = Callable[[str, bytes, Memory], Awaitable[bytes]]

_REQUESTS = 1024  # that are remembered, for who asks again
_EXPIRY_INTERVAL = 1.0  # seconds between looks for idle sessions
_LAST_CHECKPOINTS = 10.0  # seconds that the last checkpoints may take
_CHANGEABLE = ("labels", "limits", "config_json", "fabric")
# A client that left its stream may ask for the next one before its leaving is noticed here, or before the frame that is
# in the worker has been tracked.
_NOTICE_PATIENCE = 0.5  # seconds that a stream has to turn out to be left
_ENDING_PATIENCE = 5.0  # seconds that a stream which is ending has to end
_WORKER_PATIENCE = 5.0  # seconds that a call waits for its session to have a worker: less than clients wait for an answer


class Sessions:
    """All sessions of this server; lives in the event loop and never computes.

    Args:
        pool: where they are computed. Its ``on_lost`` should be :meth:`lose`.
        store: what outlives this object, opened.
        tracer: told about every frame.
    """

    def __init__(self, pool: WorkerPool, settings: Settings, metrics: Metrics, store: Store, tracer: Tracer):
        self._pool, self._settings, self._metrics, self._store = pool, settings, metrics, store
        self._records = Records(store)
        self._durability = Durability(pool, self._records, metrics, settings.checkpoint_every, self._end)
        self._outcomes = Outcomes(metrics, store.history, tracer)
        self._admission = Admission(settings)
        self._directory = Directory(self._records)
        metrics.watchers.set_function(lambda: sum(len(session.watchers) for session in self._directory))
        self._opening: dict[str, str | None] = {}  # id to owner
        self._leaving: dict[str, asyncio.Task[None]] = {}  # ended ones that are in a worker still
        self._requests: OrderedDict[tuple[str | None, str], asyncio.Future[str]] = OrderedDict()  # by owner and request id
        self.draining = False

    async def create(self, request: pb.CreateSessionRequest) -> pb.Session:
        """Creates a session, or answers the one that the same request id created. It belongs to the key of the call."""
        require_compatible(request.api_version, peer="client")
        return await self._once(request, self._pool.open)

    async def restore(self, request: pb.RestoreSessionRequest) -> pb.Session:
        """Creates a session from a snapshot."""
        require_compatible(request.api_version, peer="client")
        return await self._once(request, self._pool.restore)

    async def load(self) -> None:
        """Takes the sessions back that this server had before its process ended; tries again, in the background, for as long
        as the database cannot be reached."""
        if not await self._load():
            self._durability.background(self._load_later())

    async def _load(self) -> bool:
        try:
            sessions = await self._records.alive()
        except Unavailable as error:
            log.error("earlier sessions cannot be had back yet: %s", error)
            return False
        self._directory.complete = True
        for session in sessions:
            if session.id not in self._directory and session.id not in self._opening:
                self._directory.add(session)
                if session.request_id:
                    self._remember((session.owner, session.request_id), _done(session.id))
        if sessions:
            log.info("sessions of before the start wait for their clients", extra={"sessions": len(sessions)})
        self._durability.background(self._records.clean([*sessions, *self._directory]))
        self._count()
        return True

    async def _load_later(self) -> None:
        await asyncio.sleep(LOAD_PAUSE)
        while not (self.draining or await self._load()):
            await asyncio.sleep(LOAD_PAUSE)

    async def get(self, name: str, view: pb.SessionView = pb.SESSION_VIEW_BASIC) -> pb.Session:
        session = await self._directory.known(name)
        if view == pb.SESSION_VIEW_FULL and session.asleep:
            async with self._using(session):
                pass
        return session.message(view)

    def list(self, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
        """Those that the caller may read, oldest first, one page."""
        return self._directory.page(request)

    async def update(self, request: pb.UpdateSessionRequest) -> pb.Session:
        """Changes labels, limits, configuration and fabric, all of them or, when one cannot be used, none."""
        change, session = request.session, self._directory.mine(request.session.name)
        paths = set(request.update_mask.paths or (f.name for f, _ in change.ListFields() if f.name not in ("name", "etag")))
        if unknown := sorted(paths - set(_CHANGEABLE)):
            raise InvalidArgument(field="update_mask", expected="some of " + ", ".join(_CHANGEABLE), got=repr(unknown[0][:80]))
        labels = admission.labels(change) if "labels" in paths else None
        limits = self._admission.limits(change.limits) if "limits" in paths else None
        async with self._using(session):
            if change.etag and change.etag != str(session.revision):
                raise FailedPrecondition(
                    f"{session.name} has been changed meanwhile: its etag is {session.revision}, not {change.etag[:80]}",
                    field="etag",
                )
            if paths & {"config_json", "fabric"}:
                await self._configure(session, change, paths)
            # What is not named stays as it is now: another call may have changed it while this one waited.
            session.labels = session.labels if labels is None else labels
            session.limits = session.limits if limits is None else limits
            session.revision += 1
        self._records.save(session)
        return session.message()

    async def _configure(self, session: Session, change: pb.Session, paths: set[str]) -> None:
        """The configuration in force, or another one, and the fabric over it, or another one, as at creation."""
        opened = session.opened
        wanted = pb.Session(
            config_json=change.config_json if "config_json" in paths else opened.config_json,
            fabric=change.fabric if "fabric" in paths else opened.fabric,
        )
        answer = pb.Session.FromString(await self._pool.configure(session.id, wanted.SerializeToString()))
        await self._durability.secure(session)
        opened.config_json, opened.fabric = answer.config_json, answer.fabric

    async def reset(self, request: pb.ResetSessionRequest) -> pb.Session:
        """Starts the tracker again."""
        session = self._directory.mine(request.name)
        payload = request.SerializeToString()
        async with self._using(session):
            await self._pool.reset(session.id, payload)
            session.restarted(payload)
            await self._durability.secure(session)
        return session.message()

    async def snapshot(self, name: str) -> pb.SessionSnapshot:
        session = self._directory.mine(name)
        async with self._using(session):
            data = await self._pool.snapshot(session.id, compressed=True)
        return pb.SessionSnapshot(session=session.message(), data=data)

    @contextlib.asynccontextmanager
    async def _using(self, session: Session) -> AsyncIterator[None]:
        """For a call of the session in its worker, which it is given back before if it has lost it."""
        while True:
            if not session.seated:
                await self._seated_in_time(session)
            async with session.lock:
                if self._directory.readable(session.name) is not session:  # it ended meanwhile, and another has its name
                    raise not_found(session.name)
                if session.seated:  # still
                    session.touch()
                    yield
                    return

    async def _seated_in_time(self, session: Session) -> None:
        """Has the session restored, which goes on even where this gives up, so that its caller has an answer.

        Raises:
            Unavailable: it takes longer.
        """
        reviving = self._durability.revive(session)
        await asyncio.wait({reviving}, timeout=_WORKER_PATIENCE)
        if not reviving.done():
            raise Unavailable(f"{session.name} waits for a worker; try again later", retry_after=_WORKER_PATIENCE)
        reason = reviving.result()
        if reason and not session.closed:  # of one that has ended the directory knows why
            raise reason

    async def delete(self, name: str) -> None:
        session = self._directory.mine(name)
        self._end(session, SessionNotFound(f"{session.name} was deleted"))
        await asyncio.shield(self._leaving[session.id])

    async def open_stream(self, start: pb.Start) -> Stream:
        """The stream of a session; the caller ends with :meth:`leave_stream`."""
        require_compatible(start.api_version, peer="client")
        self._require_open_for_streams()
        await self._directory.known(start.name)
        session = self._directory.mine(start.name)
        self._require_stream_room(replaced=session.stream)
        if session.stream is not None and start.takeover:
            before = session.stream
            before.end(StreamTakenOver(f"another stream took {session.name} over"))
            await self._close_stream(before)
        elif session.stream is not None:
            await self._ended_by_itself(session.stream)
        session = self._directory.mine(start.name)  # it may have been deleted, and made by another key, meanwhile
        if session.stream is not None:
            raise _busy(session)
        mode = self._admission.mode(start.flow_mode)
        async with self._using(session):
            self._directory.mine(start.name)  # the key may have been revoked while this waited
            if session.stream is not None:  # opened while this waited
                raise _busy(session)
            self._require_open_for_streams()
            self._require_stream_room()
            session.departed = None
            parts = self._pool, self._durability, self._outcomes
            session.stream = Stream(session, start, mode, *parts, self._settings.reader_timeout, self._settings.max_image_pixels)
        self._records.save(session)
        self._count()
        return session.stream

    def leave_stream(self, stream: Stream) -> asyncio.Task[None]:
        """Closes a stream in the background: its client need not wait for a frame that is in the worker to be told why."""
        return self._durability.background(self._close_stream(stream))

    async def _close_stream(self, stream: Stream) -> None:
        """Returns when nothing of the stream is left in a worker."""
        await stream.close()
        if stream.session.stream is stream:
            stream.session.stream = None
            stream.session.departed = monotonic()
            self._records.save(stream.session)
        stream.gone.set()
        self._count()

    def watch(self, request: pb.WatchSessionRequest) -> Watcher:
        """A reader of the session's answers, with or without a stream; the caller has it ``leave``."""
        require_compatible(request.api_version, peer="client")
        session = self._directory.readable(request.name)
        self._require_stream_room()
        return session.watchers.add(session.name, session.statistics, request.every_nth, self._settings.max_watchers)

    def _require_open_for_streams(self) -> None:
        if self.draining:  # the last checkpoint would not know of its frames
            raise Draining("the server is about to stop and takes no new streams")

    def _require_stream_room(self, *, replaced: Stream | None = None) -> None:
        """For one more of the key of this call, in place of the one that is ``replaced``."""
        streams = (session.stream for session in self._directory)
        key_ids = [stream.key_id for stream in streams if stream not in (None, replaced)]
        for session in self._directory:
            key_ids += session.watchers.key_ids()
        self._admission.require_stream_room(current_principal.get(), key_ids)

    async def history(self, request: pb.GetSessionHistoryRequest) -> pb.SessionHistory:
        """What happened in a session over time, a live one or the last past one of the name.

        Raises:
            SessionNotFound: none is remembered. InvalidArgument: a time or number that makes no sense.
            Unavailable: the database cannot be reached.
        """
        found = await self._directory.last(request.name)
        if isinstance(found, Session):
            return await self._store.history.query(request, found.uid, found.created)
        return await self._store.history.query(request, found.uid, found.create_time, found.end_time)

    def shut_out(self, key_ids: Set[str]) -> None:
        """Ends the streams and watchers of keys that were revoked; their sessions end as those that were left do."""
        self._directory.shut_out(key_ids)
        reason = revoked()
        for session in self._directory if key_ids else ():
            if session.stream is not None and session.stream.key_id in key_ids:
                session.stream.end(reason)
            session.watchers.shut_out(key_ids, reason)

    def lose(self, session_ids: Sequence[str]) -> None:
        """Has the sessions whose worker is gone go on in another one, those with a stream first."""
        lost = sorted(self._directory.some(session_ids), key=lambda session: session.stream is None)
        for session in lost:
            session.seated = False
        for session in lost:
            self._durability.revive(session)

    async def expire_idle(self) -> None:
        """Ends sessions whose time is over, and registers what has changed of the others; runs until it is cancelled."""
        while True:
            await asyncio.sleep(_EXPIRY_INTERVAL)
            for session in self._directory:
                try:
                    self._expire(session)
                    self._records.save(session)
                except Exception:  # one session's trouble shall not keep the others for ever
                    log.exception("a session could not be ended as it should", extra={"session": session.id})

    def _expire(self, session: Session) -> None:
        """Ends a session if its time is over."""
        moment, reason = session.expiry()
        if monotonic() > moment:
            log.info("the session expired", extra={"session": session.id})
            self._end(session, reason)

    async def drain(self, grace: float) -> None:
        """Takes no more sessions, tells the streams, and returns when all have ended or after ``grace`` seconds, and the last
        checkpoints are taken."""
        self.draining = True
        message = f"the server stops in {grace:g} s; connect again later or elsewhere"
        for session in self._directory:
            session.tell(pb.Notice(kind=pb.NOTICE_KIND_DRAINING, message=message, value=grace))
        deadline = monotonic() + grace
        while any(s.stream for s in self._directory) and monotonic() < deadline:
            await asyncio.sleep(0.02)
        for session in self._directory:
            if session.stream:
                session.stream.notify(self._reconnect())
                session.stream.end(Draining("the server has stopped; connect again later or elsewhere"))
        for session in self._directory:
            self._durability.background(self._last_checkpoint(session))
        await self._durability.settle(_LAST_CHECKPOINTS)
        for session in self._directory:
            self._records.save(session)
            self._forsake(session, Draining("the server has stopped; connect again later or elsewhere"))

    def _reconnect(self) -> pb.Notice:
        where = self._settings.successor
        message = f"connect again{f' to {where}' if where else ''}; the session waits there"
        return pb.Notice(kind=pb.NOTICE_KIND_RECONNECT, message=message, target=where)

    async def _last_checkpoint(self, session: Session) -> None:
        """Of what was tracked since the one before; a frame that is in the worker is waited for."""
        async with session.lock:
            if session.seated and session.placed != session.statistics.frames_applied:
                self._durability.checkpoint(session)

    async def _ended_by_itself(self, stream: Stream) -> None:
        """Returns when a stream whose client has left is gone; without it, when the patience is at its end."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_NOTICE_PATIENCE):
                await stream.ending.wait()
            async with asyncio.timeout(_ENDING_PATIENCE):
                await stream.gone.wait()

    async def _once(self, request, open_: _Open) -> pb.Session:
        """Runs a creation, or waits for the same request's first run."""
        principal = current_principal.get()
        owner, request_id = principal.id or None, request.request_id
        admission.require_short(request_id)
        asked = owner, request_id
        if asked in self._requests:
            return self._directory.mine("sessions/" + await asyncio.shield(self._requests[asked])).message()
        session_id = self._new_id(request.session_id, principal)
        outcome: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        if request_id:
            self._remember(asked, outcome)
        self._opening[session_id] = owner
        try:
            session = await self._open(session_id, request, owner, open_)
        except BaseException as error:
            self._requests.pop(asked, None)
            outcome.set_exception(error if isinstance(error, ServiceError) else Unavailable("the first call was cut off"))
            outcome.exception()  # seen, even where nobody else waits for it
            raise
        finally:
            del self._opening[session_id]
        outcome.set_result(session_id)
        await self._records.written(session)
        return session.message()

    async def _open(self, session_id: str, request, owner: str | None, open_: _Open) -> Session:
        limits, labels = self._admission.limits(request.session.limits), admission.labels(request.session)
        if leaving := self._leaving.get(session_id):  # the one before of this id
            await asyncio.wait({leaving})
        opened = pb.Session.FromString(await open_(session_id, request.SerializeToString(), self._admission.memory(request)))
        session = Session(
            session_id, opened, taken_meshes(opened), limits, labels=labels, owner=owner, request_id=request.request_id
        )
        self._directory.add(session)
        self._count()
        self._records.create(session)
        self._durability.checkpoint(session)
        log.info("the session was created", extra={"session": session_id, "vertices": opened.garment_vertex_count})
        return session

    def _new_id(self, wanted: str, principal: Principal) -> str:
        if self.draining:
            raise Draining("the server is about to stop and takes no new sessions")
        self._admission.require_room(principal, [*(session.owner for session in self._directory), *self._opening.values()])
        session_id = admission.session_id(wanted)
        if session_id in self._directory or session_id in self._opening:
            raise SessionExists(f"sessions/{session_id} exists already")
        return session_id

    def _end(self, session: Session, reason: ServiceError) -> None:
        """The session is gone for good; whoever asks for it, and its stream, is told why. Its worker forgets it in the
        background, so that it does even where whoever ended the session has left."""
        if not session.closed:
            self._forsake(session, reason)
            self._records.end(session, reason)
            leaving = self._leaving[session.id] = self._durability.background(self._forget(session))
            leaving.add_done_callback(lambda _: self._leaving.pop(session.id))

    def _forsake(self, session: Session, reason: ServiceError) -> None:
        """This process has the session no more; it may live on in the store."""
        self._directory.remove(session, reason)
        session.closed = True
        if session.stream:
            session.stream.end(reason)
        session.watchers.close(reason)
        self._count()

    async def _forget(self, session: Session) -> None:
        async with session.lock:
            with contextlib.suppress(WorkerLost):  # a lost worker took the session with it
                await self._pool.close(session.id)

    def _remember(self, asked: tuple[str | None, str], outcome: asyncio.Future[str]) -> None:
        self._requests[asked] = outcome
        while len(self._requests) > _REQUESTS:
            self._requests.popitem(last=False)

    def _count(self) -> None:
        self._metrics.sessions.set(len(self._directory))
        self._metrics.streams.set(sum(s.stream is not None for s in self._directory))


def _busy(session: Session) -> SessionBusy:
    return SessionBusy(f"{session.name} has a stream already; ask for takeover to end it")


def _done(session_id: str) -> asyncio.Future[str]:
    outcome = asyncio.get_running_loop().create_future()
    outcome.set_result(session_id)
    return outcome

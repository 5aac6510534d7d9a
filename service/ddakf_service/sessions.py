"""The sessions of a server: creation, look-up, expiry, streams. Every transport speaks to this class alone."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import secrets
from collections import OrderedDict
from collections.abc import Iterable, Sequence

from ddakf_api.errors import (
    Draining,
    InvalidArgument,
    ResourceExhausted,
    ServiceError,
    SessionBusy,
    SessionExists,
    SessionExpired,
    SessionNotFound,
    StreamTakenOver,
    Unavailable,
    Unimplemented,
    WorkerLost,
)
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.version import require_compatible

from .session import Session
from .settings import Settings
from .stream import Stream
from .telemetry import Metrics
from .watch import Watcher
from .workers import WorkerPool, worker_lost

log = logging.getLogger(__name__)

_SESSION_ID = re.compile(r"[a-z][a-z0-9-]{3,62}")
_PAGE_SIZE, _MAX_PAGE_SIZE = 50, 1000
_REMEMBERED = 1024  # ids of ended sessions, and of requests, that are kept for a precise answer
_MAX_LABELS, _MAX_TEXT = 64, 256  # labels of a session; characters of a label, its value or a request id
_EXPIRY_INTERVAL = 1.0  # seconds between looks for idle sessions
_RETRY_WHEN_FULL = 5.0  # seconds
# A client that left its stream may ask for the next one before its leaving is noticed here, or before the frame that is
# in the worker has been tracked.
_NOTICE_PATIENCE = 0.5  # seconds that a stream has to turn out to be left
_ENDING_PATIENCE = 5.0  # seconds that a stream which is ending has to end


class Sessions:
    """All sessions of this server; lives in the event loop and never computes.

    Args:
        pool: where they are computed. Its ``on_lost`` should be :meth:`lose`.
    """

    def __init__(self, pool: WorkerPool, settings: Settings, metrics: Metrics):
        self._pool, self._settings, self._metrics = pool, settings, metrics
        self._sessions: dict[str, Session] = {}
        self._opening: set[str] = set()
        self._ended: OrderedDict[str, ServiceError] = OrderedDict()
        self._requests: OrderedDict[str, asyncio.Future[str]] = OrderedDict()
        self.draining = False

    async def create(self, request: pb.CreateSessionRequest) -> pb.Session:
        """Creates a session, or answers the one that the same request id created."""
        require_compatible(request.api_version, peer="client")
        return await self._once(request.request_id, request.session_id, request, self._pool.open)

    async def restore(self, request: pb.RestoreSessionRequest) -> pb.Session:
        """Creates a session from a snapshot."""
        require_compatible(request.api_version, peer="client")
        return await self._once(request.request_id, request.session_id, request, self._pool.restore)

    def get(self, name: str, view: pb.SessionView = pb.SESSION_VIEW_BASIC) -> pb.Session:
        return self._find(name).message(view)

    def list(self, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
        """Oldest first, one page; the token is the id of the last session of the page before."""
        size = min(request.page_size or _PAGE_SIZE, _MAX_PAGE_SIZE)
        wanted = [s for s in self._sessions.values() if _matches(s, request)]
        wanted.sort(key=_token)
        if request.page_token:
            wanted = [s for s in wanted if _token(s) > request.page_token]
        page = wanted[:size]
        more = _token(page[-1]) if len(wanted) > size else ""
        return pb.ListSessionsResponse(sessions=[s.message() for s in page], next_page_token=more)

    def update(self, request: pb.UpdateSessionRequest) -> pb.Session:
        """Changes labels and limits."""
        session = self._find(request.session.name)
        paths = request.update_mask.paths or [f.name for f, _ in request.session.ListFields() if f.name != "name"]
        for path in paths:
            if path in ("config_json", "fabric"):
                raise Unimplemented(f"{path} cannot be changed in a running session; create a new one")
            if path not in ("labels", "limits"):
                raise InvalidArgument(field="update_mask", expected='some of "labels", "limits"', got=repr(path))
        if "labels" in paths:
            session.labels = _labels(request.session)
        if "limits" in paths:
            session.limits = self._limits(request.session.limits)
        session.revision += 1
        return session.message()

    async def reset(self, request: pb.ResetSessionRequest) -> pb.Session:
        """Starts the tracker again."""
        session = self._find(request.name)
        async with session.lock:
            await self._pool.reset(session.id, request.SerializeToString())
        session.restarted()
        return session.message()

    async def snapshot(self, name: str) -> pb.SessionSnapshot:
        session = self._find(name)
        async with session.lock:
            data = await self._pool.snapshot(session.id)
        return pb.SessionSnapshot(session=session.message(), data=data)

    async def delete(self, name: str) -> None:
        session = self._find(name)
        self._end(session, SessionNotFound(f"{session.name} was deleted"))
        await self._forget(session)

    async def open_stream(self, start: pb.Start) -> Stream:
        """The stream of a session; the caller closes it with :meth:`close_stream`."""
        require_compatible(start.api_version, peer="client")
        session = self._find(start.name)
        if session.stream is not None and start.takeover:
            before = session.stream
            before.end(StreamTakenOver(f"another stream took {session.name} over"))
            await self.close_stream(before)
        elif session.stream is not None:
            await self._ended_by_itself(session.stream)
        session = self._find(start.name)
        if session.stream is not None:
            raise SessionBusy(f"{session.name} has a stream already; ask for takeover to end it")
        session.touch()
        session.stream = Stream(session, start, self._pool, self._metrics, self._mode(start.flow_mode))
        self._count()
        return session.stream

    async def close_stream(self, stream: Stream) -> None:
        """Returns when nothing of the stream is left in a worker."""
        await stream.close()
        if stream.session.stream is stream:
            stream.session.stream = None
        stream.gone.set()
        self._count()

    def watch(self, request: pb.WatchSessionRequest) -> Watcher:
        """A reader of the session's answers, with or without a stream; the caller has it ``leave``."""
        require_compatible(request.api_version, peer="client")
        session = self._find(request.name)
        return session.watchers.add(session.name, session.statistics, request.every_nth, self._settings.max_watchers)

    def lose(self, session_ids: Sequence[str]) -> None:
        """Ends the sessions whose worker is gone."""
        for session in self._existing(session_ids):
            log.error("the session was lost with its worker", extra={"session": session.id})
            self._end(session, worker_lost(session.id))

    async def expire_idle(self) -> None:
        """Ends sessions that had no frame for their idle timeout; runs until it is cancelled."""
        while True:
            await asyncio.sleep(_EXPIRY_INTERVAL)
            for session in list(self._sessions.values()):
                try:
                    await self._expire(session)
                except Exception:  # one session's trouble shall not keep the others for ever
                    log.exception("a session could not be ended as it should", extra={"session": session.id})

    async def _expire(self, session: Session) -> None:
        """Ends a session if it is idle now, and is still there: others may have ended while this was waited for."""
        idle = session.limits.idle_timeout
        if session.idle_for <= idle or self._sessions.get(session.id) is not session:
            return
        log.info("the session expired", extra={"session": session.id})
        self._end(session, SessionExpired(f"{session.name} had no frame for {idle:g} s and has expired"))
        await self._forget(session)

    async def drain(self, grace: float) -> None:
        """Takes no more sessions, tells the streams, and returns when all have ended or after ``grace`` seconds."""
        self.draining = True
        message = f"the server stops in {grace:g} s; connect again later or elsewhere"
        notice = pb.Notice(kind=pb.NOTICE_KIND_DRAINING, message=message, value=grace)
        for session in self._sessions.values():
            if session.stream:
                session.stream.notify(notice)
            else:
                session.watchers.publish(pb.TrackResponse(notice=notice))
        deadline = asyncio.get_running_loop().time() + grace
        while any(s.stream for s in self._sessions.values()) and asyncio.get_running_loop().time() < deadline:
            await asyncio.sleep(0.02)
        for session in list(self._sessions.values()):
            self._end(session, Draining("the server has stopped; connect again later or elsewhere"))

    async def _ended_by_itself(self, stream: Stream) -> None:
        """Returns when a stream whose client has left is gone; without it, when the patience is at its end."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_NOTICE_PATIENCE):
                await stream.ending.wait()
            async with asyncio.timeout(_ENDING_PATIENCE):
                await stream.gone.wait()

    async def _once(self, request_id: str, session_id: str, request, open_) -> pb.Session:
        """Runs a creation, or waits for the same request's first run."""
        if len(request_id) > _MAX_TEXT:
            raise InvalidArgument(field="request_id", expected=f"at most {_MAX_TEXT} characters", got=str(len(request_id)))
        if request_id in self._requests:
            return self._find("sessions/" + await asyncio.shield(self._requests[request_id])).message()
        session_id = self._new_id(session_id)
        outcome: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        if request_id:
            self._remember(self._requests, request_id, outcome)
        self._opening.add(session_id)
        try:
            session = await self._open(session_id, request, open_)
        except BaseException as error:
            self._requests.pop(request_id, None)
            outcome.set_exception(error if isinstance(error, ServiceError) else Unavailable("the first call was cut off"))
            outcome.exception()  # seen, even where nobody else waits for it
            raise
        finally:
            self._opening.discard(session_id)
        outcome.set_result(session_id)
        return session.message()

    async def _open(self, session_id: str, request, open_) -> Session:
        limits, labels = self._limits(request.session.limits), _labels(request.session)
        opened = pb.Session.FromString(await open_(session_id, request.SerializeToString()))
        meshes = pb.Session(garment=opened.garment)
        if opened.HasField("body"):
            meshes.body.CopyFrom(opened.body)
        opened.ClearField("garment")
        opened.ClearField("body")
        session = Session(session_id, opened, meshes, limits, labels=labels)
        self._sessions[session_id] = session
        self._ended.pop(session_id, None)
        self._count()
        log.info("the session was created", extra={"session": session_id, "vertices": opened.garment_vertex_count})
        return session

    def _new_id(self, wanted: str) -> str:
        if self.draining:
            raise Draining("the server is about to stop and takes no new sessions")
        if len(self._sessions) + len(self._opening) >= self._settings.max_sessions:
            raise ResourceExhausted(
                f"sessions: the server has its {self._settings.max_sessions} already; try again later or delete one",
                retry_after=_RETRY_WHEN_FULL,
            )
        if not wanted:
            return "s-" + secrets.token_hex(8)
        if not _SESSION_ID.fullmatch(wanted):
            raise InvalidArgument(field="session_id", expected="4-63 of [a-z0-9-] beginning with a letter", got=repr(wanted[:80]))
        if wanted in self._sessions or wanted in self._opening:
            raise SessionExists(f"sessions/{wanted} exists already")
        return wanted

    def _limits(self, asked: pb.SessionLimits) -> pb.SessionLimits:
        """What the client asked for, lowered to what the server allows."""
        s = self._settings
        if asked.idle_timeout < 0:
            raise InvalidArgument(
                field="limits.idle_timeout", expected="a positive number of seconds", got=f"{asked.idle_timeout:g}"
            )
        return pb.SessionLimits(
            max_points=min(asked.max_points or s.max_points, s.max_points),
            idle_timeout=min(asked.idle_timeout or s.idle_timeout, s.idle_timeout),
            max_frames_in_flight=min(asked.max_frames_in_flight or s.lossless_queue, s.lossless_queue),
        )

    def _mode(self, asked: pb.FlowMode) -> pb.FlowMode:
        if asked not in pb.FlowMode.values():
            raise InvalidArgument(field="flow_mode", expected="realtime or lossless", got=f"unknown value {asked}")
        if asked != pb.FLOW_MODE_UNSPECIFIED:
            return asked
        return pb.FLOW_MODE_LOSSLESS if self._settings.default_flow == "lossless" else pb.FLOW_MODE_REALTIME

    def _find(self, name: str) -> Session:
        session_id = name.removeprefix("sessions/")
        if session_id in self._sessions:
            return self._sessions[session_id]
        if session_id in self._ended:
            raise self._ended[session_id]
        raise SessionNotFound(f"there is no session {name[:80]!r}")

    def _existing(self, session_ids: Iterable[str]) -> list[Session]:
        return [self._sessions[i] for i in session_ids if i in self._sessions]

    def _end(self, session: Session, reason: ServiceError) -> None:
        """The session is gone; whoever asks for it, and its stream, is told why."""
        self._sessions.pop(session.id, None)
        self._remember(self._ended, session.id, reason)
        if session.stream:
            session.stream.end(reason)
        session.watchers.close(reason)
        self._count()

    async def _forget(self, session: Session) -> None:
        with contextlib.suppress(WorkerLost):  # a lost worker took the session with it
            await self._pool.close(session.id)

    def _remember(self, memory: OrderedDict, key: str, value) -> None:
        memory[key] = value
        while len(memory) > _REMEMBERED:
            memory.popitem(last=False)

    def _count(self) -> None:
        self._metrics.sessions.set(len(self._sessions))
        self._metrics.streams.set(sum(s.stream is not None for s in self._sessions.values()))


def _labels(session: pb.Session) -> dict[str, str]:
    labels = dict(session.labels)
    if len(labels) > _MAX_LABELS:
        raise InvalidArgument(field="labels", expected=f"at most {_MAX_LABELS}", got=str(len(labels)))
    longest = max((len(text) for pair in labels.items() for text in pair), default=0)
    if longest > _MAX_TEXT:
        raise InvalidArgument(field="labels", expected=f"at most {_MAX_TEXT} characters each", got=str(longest))
    return labels


def _matches(session: Session, request: pb.ListSessionsRequest) -> bool:
    return (not request.states or session.state in request.states) and all(
        session.labels.get(key) == value for key, value in request.labels.items()
    )


def _token(session: Session) -> str:
    return f"{int(session.created * 1e6):020d}-{session.id}"

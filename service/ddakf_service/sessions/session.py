"""One session as the server knows it: who it is, what happened to its frames, and which stream it has."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Set
from dataclasses import dataclass, field
from time import monotonic
from typing import Protocol

from ddakf_api.errors import ServiceError, SessionExpired
from ddakf_api.v1 import tracking_pb2 as pb

from ..store.session_record import new_uid
from ..workers.pool import Memory
from .watchers import Watchers

_RATE_WINDOW = 3.0  # seconds over which the frame rate is counted
_IDLE_AFTER = 2.0  # seconds without a frame after which a session counts as idle
_LAST_TIME = 253_402_300_799  # seconds since 1970 that a Timestamp holds: the end of the year 9999


class ClientStream(Protocol):
    """The stream of a session, as far as the session knows it.

    Attributes:
        key_id: of the key that opened it; empty: none.
    """

    key_id: str

    def notify(self, notice: pb.Notice) -> None:
        """Sends a notice to the client."""

    def end(self, error: Exception | None) -> None:
        """Ends the stream; the client gets the error."""


@dataclass(eq=False)
class Session:
    """State of a session outside its tracker.

    Attributes:
        id: as in ``sessions/{id}``.
        opened: what the worker answered when the session was created: configuration, counts, vertex map.
        meshes: garment and body, apart because only the full view shows them.
        labels, limits: as the client set them, within the server's bounds.
        lock: held by whoever has a call of this session in the worker.
        watchers: who reads the answers beside the session's client.
        owner: the key that it was created with; None: none was needed.
        request_id: of its creation, if there was one.
        uid: a number that no other session has, or ever had.
        seated: its tracker is in a worker.
        asleep: it is known from the store alone, not even its meshes are here.
        checkpoint: the newest snapshot, from which it goes on when its worker is lost.
        checkpoint_time: when that was taken, seconds since 1970.
        checkpoint_number: of that one; later ones have larger numbers.
        placed: frames that were applied when a checkpoint was last asked for.
        resumed: frames that were applied when it last went on from a checkpoint: those before are not forgotten twice.
        last_reset: the serialised request of the last reset, where a session without a checkpoint begins again.
        blames: when a worker was lost while it tracked a frame of this session (monotonic clock, seconds).
        closed: it is no more.
        departed: when its last stream ended (monotonic clock, seconds); None: it has one, or never had.
    """

    id: str
    opened: pb.Session
    meshes: pb.Session
    limits: pb.SessionLimits
    labels: dict[str, str] = field(default_factory=dict)
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    stream: ClientStream | None = None
    watchers: Watchers = field(default_factory=Watchers)
    statistics: pb.SessionStatistics = field(default_factory=pb.SessionStatistics)
    revision: int = 1
    created: float = field(default_factory=time.time)
    last_active: float = field(default_factory=monotonic)
    owner: str | None = None
    request_id: str = ""
    uid: int = field(default_factory=new_uid)
    seated: bool = True
    asleep: bool = False
    checkpoint: pb.SessionSnapshot | None = None
    checkpoint_time: float | None = None
    checkpoint_number: int = 0
    placed: int = 0
    resumed: int = 0
    last_reset: bytes = b""
    blames: deque[float] = field(default_factory=lambda: deque(maxlen=8))
    closed: bool = False
    departed: float | None = None
    _state: pb.SessionState = pb.SESSION_STATE_INITIALIZING
    _applied: deque[float] = field(default_factory=deque)

    @property
    def name(self) -> str:
        return f"sessions/{self.id}"

    @property
    def memory(self) -> Memory:
        """Estimate for its worker."""
        count, body = self.opened.garment_vertex_count, self.opened.body_vertex_count
        # A closed surface has twice as many faces as vertices; of the body's nobody has counted them.
        return Memory.of(count, self.opened.garment_face_count, body, 2 * body, self.limits.max_points)

    def touch(self) -> None:
        """The session is in use: its idle time starts again."""
        self.last_active = monotonic()

    @property
    def idle_for(self) -> float:
        """Seconds since the last use."""
        return monotonic() - self.last_active

    def expiry(self) -> tuple[float, SessionExpired]:
        """When it expires if nothing more comes (monotonic clock, seconds), and what is said then."""
        lifetime, idle, departure = self.limits.max_lifetime, self.limits.idle_timeout, self.limits.departure_timeout
        ends = [(self.last_active + idle, f"had no frame for {idle:g} s")]
        if self.departed is not None:
            away = max(self.departed, self.last_active) + departure
            ends = [(away, f"was left by its client, which did not come back within {departure:g} s")]
        if lifetime > 0:
            ends.append((monotonic() + self.created + lifetime - time.time(), f"has lived for {lifetime:g} s, its longest"))
        moment, why = min(ends)
        return moment, SessionExpired(f"{self.name} {why} and has expired")

    @property
    def state(self) -> pb.SessionState:
        return pb.SESSION_STATE_IDLE if self.stream is None or self.idle_for > _IDLE_AFTER else self._state

    def record_result(self, result: pb.Result, arrived: float) -> None:
        """Counts an applied frame, and writes the session's counters into its result."""
        now = monotonic()
        self.last_active = now
        self._applied.append(now)
        self._forget_before(now - _RATE_WINDOW)
        self._state = pb.SessionState.ValueType(result.state)
        s = self.statistics
        s.frames_applied += 1
        s.reliability, s.paper_score, s.coverage = result.reliability, result.paper_score, result.coverage
        s.last_sequence_number, s.last_capture_time = result.sequence_number, result.capture_time
        s.last_frame_time.FromNanoseconds(time.time_ns())
        s.last_latency = now - arrived
        result.frames_applied, result.frames_dropped = s.frames_applied, s.frames_dropped
        result.frames_rejected, result.frames_late = s.frames_rejected, s.frames_late

    def forget_since(self, checkpoint: pb.SessionStatistics) -> int:
        """The tracker went back to a checkpoint; returns how many applied frames were forgotten by that."""
        s = self.statistics
        forgotten = max(s.frames_applied - max(checkpoint.frames_applied, self.resumed), 0)
        self.resumed = s.frames_applied
        s.recoveries += 1
        s.frames_lost += forgotten
        s.last_sequence_number, s.last_capture_time = checkpoint.last_sequence_number, checkpoint.last_capture_time
        return forgotten

    def frame_rate(self) -> float:
        """Frames applied per second over the last few seconds."""
        now = monotonic()
        self._forget_before(now - _RATE_WINDOW)
        if len(self._applied) < 2:
            return 0.0
        return (len(self._applied) - 1) / max(now - self._applied[0], 1e-6)

    def _forget_before(self, then: float) -> None:
        while self._applied and self._applied[0] < then:
            self._applied.popleft()

    def tell(self, notice: pb.Notice) -> None:
        """Tells whoever reads the session's answers something in between."""
        if self.stream is not None:
            self.stream.notify(notice)
        else:
            self.watchers.publish(pb.TrackResponse(notice=notice))

    def restarted(self, request: bytes) -> None:
        """The tracker starts again, as a serialised request said."""
        self._state, self.last_reset = pb.SESSION_STATE_INITIALIZING, request
        self.touch()

    def shut_out(self, key_ids: Set[str], error: ServiceError) -> None:
        """Ends the stream and the watchers of these keys."""
        if self.stream is not None and self.stream.key_id in key_ids:
            self.stream.end(error)
        self.watchers.shut_out(key_ids, error)

    def beginning(self) -> pb.CreateSessionRequest:
        """The request that opens the session again as it was opened."""
        start = pb.Session(config_json=self.opened.config_json)
        start.MergeFrom(self.meshes)
        return pb.CreateSessionRequest(session=start)

    def message(self, view: pb.SessionView = pb.SESSION_VIEW_BASIC) -> pb.Session:
        """The resource, with its meshes only in the full view."""
        session = pb.Session()
        session.CopyFrom(self.opened)
        if view == pb.SESSION_VIEW_FULL:
            session.MergeFrom(self.meshes)
        session.name, session.state, session.etag = self.name, self.state, str(self.revision)
        session.create_time.FromNanoseconds(int(self.created * 1e9))
        session.limits.CopyFrom(self.limits)
        session.labels.update(self.labels)
        session.statistics.CopyFrom(self.statistics)
        session.statistics.frame_rate = self.frame_rate()
        session.statistics.memory_bytes = sum(self.memory)
        moment, _ = self.expiry()
        if (expires := time.time() + moment - monotonic()) < _LAST_TIME:
            session.expire_time.FromNanoseconds(int(expires * 1e9))
        if self.checkpoint_time is not None:
            session.checkpoint_time.FromNanoseconds(int(self.checkpoint_time * 1e9))
        return session


def taken_meshes(opened: pb.Session) -> pb.Session:
    """Garment and body of a worker's answer, which loses them."""
    meshes = pb.Session(garment=opened.garment)
    if opened.HasField("body"):
        meshes.body.CopyFrom(opened.body)
    opened.ClearField("garment")
    opened.ClearField("body")
    return meshes

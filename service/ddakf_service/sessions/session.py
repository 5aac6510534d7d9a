"""Session: identity, limits, counters, stream and checkpoint of one session, outside its tracker."""

from __future__ import annotations

import asyncio
import logging
import re
from collections import deque
from collections.abc import Set
from dataclasses import dataclass, field
from time import monotonic
from typing import Protocol

from ddakf_api.errors import ServiceError, SessionExpired
from ddakf_api.v1 import tracking_pb2 as pb

from ..store.clock import clock
from ..store.tables.session_record import new_uid
from ..workers.pool import Memory
from .responses.answers import Answers
from .responses.response import Response
from .responses.watchers import Watchers

log = logging.getLogger(__name__)

_FRAME_RATE_WINDOW = 3.0  # seconds over which the frame rate is counted
_IDLE_AFTER = 2.0  # seconds without a frame after which a session counts as idle
_SESSION_ID = re.compile(r"[a-z][a-z0-9-]{3,62}")
_MAX_TIMESTAMP = 253_402_300_799  # seconds since 1970 that a Timestamp holds: the end of the year 9999


class ClientStream(Protocol):
    """The stream of a session, as far as the session knows it.

    Attributes:
        key_id: of the key that opened it; empty: none.
        busy: a frame waits for its answer.
    """

    key_id: str
    busy: bool

    def notify(self, notice: pb.Notice) -> None:
        """Sends a notice to the client."""

    def end(self, error: Exception | None) -> None:
        """Ends the stream; the client gets the error."""

    async def close(self) -> None:
        """Drops queued frames and returns when the frame in the worker, if any, has been counted."""


@dataclass(eq=False)
class Session:
    """State of a session outside its tracker.

    Attributes:
        id: as in ``sessions/{id}``.
        description: the worker's answer to the creation: configuration, counts, vertex map.
        meshes: garment and body; separate, because only the full view contains them.
        labels, limits: as requested by the client, within the server's bounds.
        lock: held during a call of this session in the worker.
        watchers: readers of the responses beside the session's client.
        owner: id of the key that created the session; None: no key was needed.
        request_id: of the creation, if any.
        uid: number that no other session has or had.
        has_worker: the tracker is in a worker.
        stored_only: the session was loaded from the store without its meshes.
        checkpoint: the newest snapshot, for a restore after the loss of the worker.
        checkpoint_time: of that snapshot, seconds since 1970.
        checkpoint_number: of that snapshot; increases with each one.
        checkpointed_frames: applied frames when the last checkpoint was requested.
        resumed_frames: applied frames at the last restore; frames before it are not counted as lost again.
        answers: the newest of its lossless streams.
        last_reset: serialised request of the last reset, for a restore without a checkpoint.
        worker_losses: times at which a worker was lost over a frame of this session (monotonic clock, seconds).
        costly_frames: number of frames that exceeded their limit, less what later ones undid.
        closed: the session has ended.
        epoch: of the lease, where servers share sessions; else 0.
        leased_at: time since which this server has had the lease (monotonic clock, seconds).
        departure_time: end of the last stream (monotonic clock, seconds); None: a stream is open, or none ever was.
    """

    id: str
    description: pb.Session
    meshes: pb.Session
    limits: pb.SessionLimits
    labels: dict[str, str] = field(default_factory=dict)
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    stream: ClientStream | None = None
    watchers: Watchers = field(default_factory=Watchers)
    statistics: pb.SessionStatistics = field(default_factory=pb.SessionStatistics)
    revision: int = 1
    created: float = field(default_factory=clock.now)
    last_active: float = field(default_factory=monotonic)
    owner: str | None = None
    request_id: str = ""
    uid: int = field(default_factory=new_uid)
    has_worker: bool = True
    stored_only: bool = False
    checkpoint: pb.SessionSnapshot | None = None
    checkpoint_time: float | None = None
    checkpoint_number: int = 0
    checkpointed_frames: int = 0
    resumed_frames: int = 0
    answers: Answers = field(default_factory=Answers)
    last_reset: bytes = b""
    worker_losses: deque[float] = field(default_factory=lambda: deque(maxlen=8))
    costly_frames: float = 0.0
    closed: bool = False
    epoch: int = 0
    leased_at: float = field(default_factory=monotonic)
    departure_time: float | None = None
    _created: float = field(init=False)  # monotonic clock, seconds: the other one may be set
    _state: pb.SessionState = pb.SESSION_STATE_INITIALIZING
    _applied: deque[float] = field(default_factory=deque)

    def __post_init__(self):
        self._created = monotonic() + self.created - clock.now()

    @property
    def name(self) -> str:
        return f"sessions/{self.id}"

    @property
    def memory(self) -> Memory:
        """Estimated memory in the worker."""
        return self.memory_with(self.limits)

    def memory_with(self, limits: pb.SessionLimits) -> Memory:
        """Estimated memory in the worker with other limits."""
        count, body = self.description.garment_vertex_count, self.description.body_vertex_count
        # The body's faces are not counted; a closed surface has twice as many faces as vertices.
        return Memory.of(count, self.description.garment_face_count, body, 2 * body, limits.max_points)

    def touch(self) -> None:
        """Restarts the idle time."""
        self.last_active = monotonic()

    @property
    def idle_for(self) -> float:
        """Seconds since the last use."""
        return monotonic() - self.last_active

    def expiry(self) -> tuple[float, SessionExpired]:
        """Time of expiry without further frames (monotonic clock, seconds), and the error after it."""
        lifetime, idle, departure = self.limits.max_lifetime, self.limits.idle_timeout, self.limits.departure_timeout
        is_busy = self.stream is not None and self.stream.busy  # its worker may be slow, or be replaced
        expiries = [((monotonic() if is_busy else self.last_active) + idle, f"had no frame for {idle:g} s")]
        if self.departure_time is not None:
            departure_expiry = max(self.departure_time, self.last_active) + departure
            expiries = [(departure_expiry, f"was left by its client, which did not return within {departure:g} s")]
        if lifetime > 0:
            expiries.append((self._created + lifetime, f"reached its lifetime of {lifetime:g} s"))
        moment, explanation = min(expiries)
        return moment, SessionExpired(f"{self.name} {explanation} and has expired")

    @property
    def state(self) -> pb.SessionState:
        return pb.SESSION_STATE_IDLE if self.stream is None or self.idle_for > _IDLE_AFTER else self._state

    def record_result(self, result: pb.Result, arrived: float) -> None:
        """Counts an applied frame, and writes the session's counters into its result."""
        now = monotonic()
        self.last_active = now
        self._applied.append(now)
        self._forget_before(now - _FRAME_RATE_WINDOW)
        self._state = pb.SessionState.ValueType(result.state)
        s = self.statistics
        s.frames_applied += 1
        s.reliability, s.paper_score, s.coverage = result.reliability, result.paper_score, result.coverage
        s.last_sequence_number, s.last_capture_time = result.sequence_number, result.capture_time
        s.last_frame_time.FromNanoseconds(int(clock.now() * 1e9))
        s.last_latency = now - arrived
        for warning in result.warnings:
            self._count_warning(warning)
        result.frames_applied, result.frames_dropped = s.frames_applied, s.frames_dropped
        result.frames_rejected, result.frames_late = s.frames_rejected, s.frames_late

    def _count_warning(self, warning: pb.Warning) -> None:
        counts = self.statistics.warnings
        count = next((known for known in counts if known.warning.code == warning.code), None)
        if count is None:
            count = counts.add()
            log.warning("%s: %s", warning.field, warning.message, extra={"session": self.id})
        count.warning.CopyFrom(warning)
        count.frames += 1

    def record_answer(self, response: Response, most: int) -> None:
        """Records the answer to a frame of a lossless stream, for a client that loses its connection before the answer.

        Args:
            most: frames that the client may have unanswered, as its stream was told; a change of the limits holds from the next.
        """
        self.answers.add(response, most)

    def record_recovery(self, checkpoint: pb.SessionStatistics) -> int:
        """Records that the tracker was restored from a checkpoint. Returns the number of applied frames that were lost."""
        s = self.statistics
        s.frames_applied = max(s.frames_applied, checkpoint.frames_applied)  # its row may be older than its checkpoint
        lost = max(s.frames_applied - max(checkpoint.frames_applied, self.resumed_frames), 0)
        self.resumed_frames = s.frames_applied
        s.recoveries += 1
        s.frames_lost += lost
        s.last_sequence_number, s.last_capture_time = checkpoint.last_sequence_number, checkpoint.last_capture_time
        return lost

    def frame_rate(self) -> float:
        """Applied frames per second over the last three seconds."""
        now = monotonic()
        self._forget_before(now - _FRAME_RATE_WINDOW)
        if len(self._applied) < 2:
            return 0.0
        return (len(self._applied) - 1) / max(now - self._applied[0], 1e-6)

    def _forget_before(self, then: float) -> None:
        while self._applied and self._applied[0] < then:
            self._applied.popleft()

    def notify(self, notice: pb.Notice) -> None:
        """Sends a notice to the stream and the watchers."""
        if self.stream is not None:
            self.stream.notify(notice)
        else:
            self.watchers.publish(Response(pb.TrackResponse(notice=notice)))

    def record_reset(self, request: bytes) -> None:
        """Records a reset of the tracker by a serialised request, and tells watchers of it."""
        self._state, self.last_reset = pb.SESSION_STATE_INITIALIZING, request
        self.watchers.publish(Response(pb.TrackResponse(reset=pb.ResetSessionRequest.FromString(request))))
        self.touch()

    def record_update(self, request: pb.UpdateSessionRequest) -> None:
        """Tells watchers of another configuration of the tracker."""
        self.watchers.publish(Response(pb.TrackResponse(update=request)))

    def shut_out(self, key_ids: Set[str], error: ServiceError) -> None:
        """Ends the stream and the watchers of these keys."""
        if self.stream is not None and self.stream.key_id in key_ids:
            self.stream.end(error)
        self.watchers.shut_out(key_ids, error)

    def creation_request(self) -> pb.CreateSessionRequest:
        """The request that creates the session again."""
        start = pb.Session(config_json=self.description.config_json)
        start.MergeFrom(self.meshes)
        return pb.CreateSessionRequest(session=start)

    def message(self, view: pb.SessionView = pb.SESSION_VIEW_BASIC) -> pb.Session:
        """The session as a message of the contract; with its meshes in the full view."""
        session = pb.Session()
        session.CopyFrom(self.description)
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
        if (expires := clock.now() + moment - monotonic()) < _MAX_TIMESTAMP:
            session.expire_time.FromNanoseconds(int(expires * 1e9))
        if self.checkpoint_time is not None:
            session.checkpoint_time.FromNanoseconds(int(self.checkpoint_time * 1e9))
        return session


def take_meshes(opened: pb.Session) -> pb.Session:
    """Moves garment and body out of a worker's answer."""
    meshes = pb.Session(garment=opened.garment)
    if opened.HasField("body"):
        meshes.body.CopyFrom(opened.body)
    opened.ClearField("garment")
    opened.ClearField("body")
    return meshes


def is_session_id(text: str) -> bool:
    """Whether the text has the form of a session id."""
    return _SESSION_ID.fullmatch(text) is not None

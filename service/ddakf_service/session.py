"""One session as the server knows it: who it is, what happened to its frames, and which stream it has."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from dataclasses import dataclass, field
from time import monotonic
from typing import TYPE_CHECKING

from ddakf_api.v1 import tracking_pb2 as pb

from .watch import Watchers

if TYPE_CHECKING:
    from .stream import Stream

_RATE_WINDOW = 3.0  # seconds over which the frame rate is counted
_IDLE_AFTER = 2.0  # seconds without a frame after which a session counts as idle


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
    """

    id: str
    opened: pb.Session
    meshes: pb.Session
    limits: pb.SessionLimits
    labels: dict[str, str] = field(default_factory=dict)
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    stream: Stream | None = None
    watchers: Watchers = field(default_factory=Watchers)
    statistics: pb.SessionStatistics = field(default_factory=pb.SessionStatistics)
    revision: int = 1
    created: float = field(default_factory=time.time)
    last_active: float = field(default_factory=monotonic)
    _state: pb.SessionState = pb.SESSION_STATE_INITIALIZING
    _applied: deque[float] = field(default_factory=deque)

    @property
    def name(self) -> str:
        return f"sessions/{self.id}"

    def touch(self) -> None:
        """The session is in use: its idle time starts again."""
        self.last_active = monotonic()

    @property
    def idle_for(self) -> float:
        """Seconds since the last use."""
        return monotonic() - self.last_active

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
        result.frames_rejected = s.frames_rejected

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

    def restarted(self) -> None:
        """The tracker starts again."""
        self._state = pb.SESSION_STATE_INITIALIZING
        self.touch()

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
        return session

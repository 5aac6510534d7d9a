"""History of sessions: one row of sums per second with frames, and the changes of state."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import sqlalchemy as sa
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf.timestamp_pb2 import Timestamp

from ..clock import clock
from .database import Database, delete_some
from .schema import history, state_changes

_CAPACITY = 50_000  # queued rows while the database cannot be reached; about half a kilobyte each
_MAX_CHANGES = 10_000  # changes of state in one answer
_SAMPLES, _MAX_SAMPLES = 500, 10_000


@dataclass(slots=True)
class Aggregate:
    """Sums of a session's frames over some seconds from ``second`` on. Sums are over the applied frames."""

    uid: int
    second: int
    applied: int = 0
    dropped: int = 0
    late: int = 0
    rejected: int = 0
    reliability_sum: float = 0.0
    least_reliability: float = 1.0
    paper_score_sum: float = 0.0
    coverage_sum: float = 0.0
    latency_sum: float = 0.0
    greatest_latency: float = 0.0

    def add(self, other: Aggregate) -> None:
        """Adds the frames of another aggregate."""
        for name in _SUMMED:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.least_reliability = min(self.least_reliability, other.least_reliability)
        self.greatest_latency = max(self.greatest_latency, other.greatest_latency)

    def sample(self) -> pb.HistorySample:
        count = max(self.applied, 1)
        return pb.HistorySample(
            start_time=Timestamp(seconds=self.second),
            frames_applied=self.applied,
            frames_dropped=self.dropped,
            frames_late=self.late,
            frames_rejected=self.rejected,
            reliability=self.reliability_sum / count,
            least_reliability=self.least_reliability if self.applied else 0.0,
            paper_score=self.paper_score_sum / count,
            coverage=self.coverage_sum / count,
            latency=self.latency_sum / count,
            greatest_latency=self.greatest_latency,
        )


_NAMES = [field.name for field in fields(Aggregate)]
_COUNTS = ("applied", "dropped", "late", "rejected")
_SUMMED = [name for name in _NAMES if name in _COUNTS or name.endswith("_sum")]


class Change(NamedTuple):
    """A session's state from ``time`` on, seconds since 1970."""

    uid: int
    time: float
    state: int


class _SessionBuffer:
    """A session's history in memory: the present second and the state."""

    def __init__(self, uid: int):
        self.uid = uid
        self.second: Aggregate | None = None
        self.state = pb.SESSION_STATE_UNSPECIFIED
        self.changed = 0.0


class History:
    """Frames and states of all sessions. Recording takes some microseconds and never waits.

    Args:
        retention: of rows, seconds.
        clock: returns seconds since 1970.
    """

    def __init__(self, database: Database, retention: float, clock=clock.now):
        self._database, self._retention, self._clock = database, retention, clock
        self._rows = database.queue(_CAPACITY, self._write_rows)
        self._changes = database.queue(_CAPACITY, self._write_changes)
        self._buffers: dict[int, _SessionBuffer] = {}
        self._lock = threading.Lock()
        database.periodic_task(self._forget_old)

    def applied(self, uid: int, result: pb.Result, latency: float) -> None:
        """Records a tracked frame; ``latency`` is the time from its arrival to its result, seconds."""
        with self._lock:
            if (row := self._second(uid)) is None:
                return
            row.applied += 1
            row.reliability_sum += result.reliability
            row.least_reliability = min(row.least_reliability, result.reliability)
            row.paper_score_sum += result.paper_score
            row.coverage_sum += result.coverage
            row.latency_sum += latency
            row.greatest_latency = max(row.greatest_latency, latency)

    def count(self, uid: int, outcome: str, frames: int = 1) -> None:
        """Records frames that were not tracked; ``outcome`` is "dropped", "late" or "rejected"."""
        with self._lock:
            if (row := self._second(uid)) is not None:
                setattr(row, outcome, getattr(row, outcome) + frames)

    def state(self, uid: int, state: pb.SessionState) -> None:
        """Records a session's state, if it has changed.

        The first state of a session starts its history in this process; without it no frame is recorded."""
        with self._lock:
            buffer = self._buffers.setdefault(uid, _SessionBuffer(uid))
            if state != buffer.state:
                buffer.state, buffer.changed = state, max(self._clock(), buffer.changed + 1e-6)
                change = Change(uid, buffer.changed, state)
                self._changes.put((uid, buffer.changed), change)

    def close(self, uid: int, state: pb.SessionState) -> None:
        """Records the last state of a session, expired or closed, and ends its history."""
        self.state(uid, state)
        with self._lock:
            buffer = self._buffers.pop(uid)
            if buffer.second is not None:
                self._put(buffer.second)

    def leave(self, uid: int) -> None:
        """Ends the history of a session in this process; it continues on another server."""
        with self._lock:
            buffer = self._buffers.pop(uid, None)
            if buffer is not None and buffer.second is not None:
                self._put(buffer.second)

    def close_all(self) -> None:
        """Queues the present second of every session; for a stop of the server, which the sessions survive."""
        with self._lock:
            for buffer in self._buffers.values():
                if buffer.second is not None:
                    self._put(buffer.second)

    async def query(
        self, request: pb.GetSessionHistoryRequest, uid: int, create_time: float, end_time: float | None = None
    ) -> pb.SessionHistory:
        """The history of a session, up to the last frame.

        Args:
            request: span and resolution; the span defaults to ``create_time`` until now.
            create_time, end_time: of the session, seconds since 1970; end_time None: the session is live.

        Raises:
            InvalidArgument: an invalid time or number.
            Unavailable: the database cannot be reached.
        """
        now = self._clock()
        start = _seconds(request, "start_time", create_time)
        rows, changes = self._in_memory(uid)
        newest = rows[-1].second if rows else start  # later than now if the clock was set back
        end = _seconds(request, "end_time", max(min(now, end_time or now), newest, start) + 1)
        if end < start:
            raise InvalidArgument(field="end_time", expected="a time after start_time", got=f"{start - end:g} s before it")
        step = _resolution(request, start, end)
        sums = await self._sums(uid, int(start), end, step, rows)
        changes = await self._state_changes(uid, start, end, changes)
        return await asyncio.to_thread(_message, request.name, step, sums, changes)

    def _second(self, uid: int) -> Aggregate | None:
        """The row of the present second; queues the previous one. None: the session has no history here."""
        buffer = self._buffers.get(uid)
        if buffer is None:
            return None
        second = int(self._clock())
        if buffer.second is None or second > buffer.second.second:  # a clock that is set back extends the second
            if buffer.second is not None:
                self._put(buffer.second)
            buffer.second = Aggregate(uid, second)
        return buffer.second

    def _put(self, row: Aggregate) -> None:
        self._rows.put((row.uid, row.second), replace(row))

    def _in_memory(self, uid: int) -> tuple[list[Aggregate], list[Change]]:
        """Rows and changes that may not be in the database yet, in order of time."""
        with self._lock:
            rows = {row.second: row for (owner, _), row in self._rows.pending().items() if owner == uid}
            buffer = self._buffers.get(uid)
            if buffer is not None and buffer.second is not None:
                rows[buffer.second.second] = replace(buffer.second)
            changes = [change for (owner, _), change in self._changes.pending().items() if owner == uid]
        return sorted(rows.values(), key=lambda row: row.second), changes

    async def _sums(self, uid: int, start: int, end: float, step: int, rows: list[Aggregate]) -> list[Aggregate]:
        """The stored seconds, summed in the database, and the later seconds in memory, by steps."""
        stored_until = min(end, rows[0].second) if rows else end
        bucket = (history.c.second // step * step).label("second")
        sums = [sa.func.sum(history.c[name]).label(name) for name in _SUMMED]
        extremes = [
            sa.func.min(history.c.least_reliability).label("least_reliability"),
            sa.func.max(history.c.greatest_latency).label("greatest_latency"),
        ]
        query = (
            sa.select(bucket, *sums, *extremes)
            .where(history.c.uid == uid, history.c.second >= start, history.c.second < stored_until)
            .group_by(bucket)
        )
        stored = await self._database.read(lambda c: [Aggregate(uid=uid, **row) for row in c.execute(query).mappings()])
        buckets = {row.second: row for row in stored}
        for row in rows:
            if start <= row.second < end:
                begin = row.second // step * step
                buckets.setdefault(begin, Aggregate(uid, begin)).add(row)
        return [buckets[second] for second in sorted(buckets)]

    async def _state_changes(self, uid: int, start: float, end: float, waiting: list[Change]) -> list[Change]:
        """The newest changes in the span, preceded by the state at ``start``."""
        columns = state_changes.c
        query = sa.select(state_changes).where(columns.uid == uid, columns.time < end)
        query = query.order_by(columns.time.desc()).limit(_MAX_CHANGES)
        stored = await self._database.read(lambda c: [Change(*row) for row in c.execute(query)])
        changes = sorted({change.time: change for change in [*stored, *waiting] if change.time < end}.values(), key=_time)
        before = [change for change in changes if change.time < start]
        return [*before[-1:], *changes[len(before) :]][-_MAX_CHANGES:]

    def _write_rows(self, connection: sa.Connection, rows: list[Aggregate]) -> None:
        values = [{name: getattr(row, name) for name in _NAMES} for row in rows]
        connection.execute(self._database.upsert(history), values)

    def _write_changes(self, connection: sa.Connection, changes: list[Change]) -> None:
        connection.execute(self._database.upsert(state_changes), [change._asdict() for change in changes])

    def _forget_old(self, connection: sa.Connection) -> bool:
        before = self._clock() - self._retention
        old = ((history, history.c.second < before), (state_changes, state_changes.c.time < before))
        return any([delete_some(connection, table, condition) for table, condition in old])


def _message(name: str, step: int, sums: list[Aggregate], changes: list[Change]) -> pb.SessionHistory:
    """The answer; tens of milliseconds for the most samples and changes."""
    answer = pb.SessionHistory(name=name, resolution=step, samples=[row.sample() for row in sums])
    for change in changes:
        answer.state_changes.add(state=change.state).time.FromNanoseconds(int(change.time * 1e9))
    return answer


def _time(change: Change) -> float:
    return change.time


def _seconds(request: pb.GetSessionHistoryRequest, field: str, default: float) -> float:
    if not request.HasField(field):
        return default
    stamp: Timestamp = getattr(request, field)
    if not (0 <= stamp.seconds < 1 << 40 and 0 <= stamp.nanos < 1_000_000_000):
        raise InvalidArgument(field=field, expected="a time after 1970", got=f"{stamp.seconds} s, {stamp.nanos} ns")
    return stamp.seconds + stamp.nanos / 1e9


def _resolution(request: pb.GetSessionHistoryRequest, start: float, end: float) -> int:
    """Whole seconds per sample: the requested resolution, or a coarser one for at most ``max_samples`` samples."""
    if not 0 <= request.resolution < 1 << 32:
        raise InvalidArgument(field="resolution", expected="a positive number of seconds", got=f"{request.resolution:g}")
    max_samples = min(request.max_samples or _SAMPLES, _MAX_SAMPLES)
    step = max(int(request.resolution), 1)
    first, last = int(start), max(int(end), int(start))
    if last // step - first // step < max_samples:
        return step
    if max_samples > 1:  # samples start at multiples of the step, which may add one
        return -(-(last - first) // (max_samples - 1))
    return 1 << max((first ^ last).bit_length(), step.bit_length())  # no multiple of this power of two lies between the times

"""Registry: live and past sessions in the database, for a restart of the server."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from time import monotonic

import sqlalchemy as sa
from ddakf_api.v1 import tracking_pb2 as pb

from ..clock import clock
from .database import Database, delete_some
from .schema import leases, requests, sessions
from .session_record import SessionRecord

_CAPACITY = 10_000  # queued sessions while the database cannot be reached
_LOOK_INTERVAL = 0.005  # seconds between checks whether a row is written
_ROUNDING = 2e-7  # seconds: more than a float of the present time is off
_MAX_REQUESTS = 256  # queued creation requests; each may have megabytes of meshes


class Registry:
    """Sessions in the database. Saving never waits; :meth:`newest` returns saved sessions at once.

    Args:
        retention: of ended sessions, seconds.
    """

    def __init__(self, database: Database, retention: float):
        self._database, self._retention = database, retention
        self._requests = database.queue(_MAX_REQUESTS, self._write_requests)
        self._sessions = database.queue(_CAPACITY, self._write_records)
        database.periodic_task(self._forget_old)

    def save(self, record: SessionRecord) -> None:
        """Registers a session or its changes: state, limits, statistics.

        Only the newest record of a session is written, at most a few times per second; callers may save at every change.
        """
        self._sessions.put(record.uid, record)

    async def written(self, uid: int, timeout: float) -> bool:
        """Waits until the saved session is in the database; False after ``timeout`` seconds, and while the database fails."""
        deadline = monotonic() + timeout
        with self._database.immediate_writes():
            while uid in self._sessions:
                if monotonic() > deadline or self._database.condition.problem:
                    return False
                await asyncio.sleep(_LOOK_INTERVAL)
        return True

    def save_request(self, uid: int, request: bytes) -> None:
        """Stores a live session's serialised CreateSessionRequest or RestoreSessionRequest, for a restart before its first
        checkpoint."""
        self._requests.put(uid, (uid, request))

    def end(self, record: SessionRecord, reason: pb.ErrorDetail) -> None:
        """Registers the end of a session; its history remains."""
        self._requests.discard(record.uid)
        self.save(replace(record, reason=reason, end_time=clock.now()))

    async def alive(self, server_id: str) -> list[SessionRecord]:
        """The live sessions of a server, oldest first. The caller checks their ``expire_time``.

        Raises:
            Unavailable: the database cannot be reached; retry later.
        """
        query = (
            sa.select(sessions)
            .where(sessions.c.server_id == server_id, sessions.c.end_time.is_(None))
            .order_by(sessions.c.create_time)
        )
        return await self._database.read(lambda c: [record_of(row) for row in c.execute(query)])

    async def created_by(self, owner: str | None, request_id: str) -> SessionRecord | None:
        """The live session that a request of a key has created, on any server that shares sessions; None: none is registered.

        Raises:
            Unavailable: the database cannot be reached.
        """
        query = sa.select(sessions).join(leases, leases.c.uid == sessions.c.uid)
        query = query.where(sessions.c.request_id == request_id, sessions.c.end_time.is_(None))
        query = query.where(sessions.c.owner.is_not_distinct_from(owner)).limit(1)
        found = await self._database.read(lambda c: [record_of(row) for row in c.execute(query)])
        return found[0] if found else None

    async def ended_among(self, uids: list[int]) -> list[int]:
        """Those of some sessions that have ended. Raises ``Unavailable``."""
        query = sa.select(sessions.c.uid).where(sessions.c.uid.in_(uids), sessions.c.end_time.is_not(None))
        return await self._database.read(lambda c: list(c.execute(query).scalars()))

    async def known_among(self, uids: list[int]) -> list[int]:
        """Those of some sessions that the database has. Raises ``Unavailable``."""
        query = sa.select(sessions.c.uid).where(sessions.c.uid.in_(uids))
        return await self._database.read(lambda c: list(c.execute(query).scalars()))

    async def request(self, uid: int) -> bytes | None:
        """The request stored by :meth:`save_request`, or None.

        Raises:
            Unavailable: the database cannot be reached.
        """
        waiting = self._requests.pending().get(uid)
        if waiting is not None:
            return waiting[1]
        query = sa.select(requests.c.request).where(requests.c.uid == uid)
        return await self._database.read(lambda c: c.execute(query).scalar_one_or_none())

    async def newest(self, session_id: str) -> SessionRecord | None:
        """The session of this id that has a lease, else the newest one, live or past; None: no such session.

        Raises:
            Unavailable: the database cannot be reached.
        """
        queued = [record for record in self._sessions.pending().values() if record.id == session_id]
        leased = leases.c.uid.is_not(None).label("leased")
        query = sa.select(sessions, leased).outerjoin(leases, leases.c.uid == sessions.c.uid)
        newest = query.where(sessions.c.id == session_id).order_by(leased.desc(), sessions.c.create_time.desc()).limit(1)
        same = query.where(sessions.c.uid.in_([record.uid for record in queued]))
        rows = await self._database.read(lambda c: [row for query in (newest, same) for row in c.execute(query)])
        found = {row.uid: (bool(row.leased), record_of(row)) for row in rows}
        for record in queued:
            # Of an earlier epoch: another server has had the session since, and the row will not be written.
            if record.uid not in found or record.epoch >= found[record.uid][1].epoch:
                found[record.uid] = record.reason is None and record.epoch > 0, record
        _, record = max(found.values(), key=lambda each: (each[0], each[1].create_time), default=(False, None))
        return record

    async def ended(
        self, states: list[int], owner: str | None, before: tuple[int, str] | None, count: int
    ) -> list[SessionRecord]:
        """At most ``count`` ended sessions, newest first.

        Args:
            states: EXPIRED, CLOSED or both.
            owner: of the sessions; None: any.
            before: microseconds since 1970 of the creation, and id, of a session; only those created before it.

        Raises:
            Unavailable: the database cannot be reached.
        """
        query = sa.select(sessions).where(sessions.c.end_time.is_not(None), sessions.c.state.in_(states))
        if owner is not None:
            query = query.where(sessions.c.owner == owner)
        if before is not None:
            first = before[0] / 1e6 - _ROUNDING
            same = sa.and_(sessions.c.create_time.between(first, first + 1e-6 + 2 * _ROUNDING), sessions.c.id < before[1])
            query = query.where(sa.or_(sessions.c.create_time < first, same))
        query = query.order_by(sessions.c.create_time.desc(), sessions.c.id.desc()).limit(count)
        return await self._database.read(lambda c: [record_of(row) for row in c.execute(query)])

    def _write_requests(self, connection: sa.Connection, rows: list[tuple[int, bytes]]) -> None:
        values = [{"uid": uid, "request": request} for uid, request in rows]
        connection.execute(self._database.upsert(requests), values)

    def _write_records(self, connection: sa.Connection, records: list[SessionRecord]) -> None:
        # A server whose lease another one has taken over changes nothing.
        connection.execute(self._database.upsert(sessions, fence="epoch"), [_row(record) for record in records])
        ended = [record.uid for record in records if record.reason is not None]
        over = sa.select(sessions.c.uid).where(sessions.c.uid.in_(ended), sessions.c.end_time.is_not(None))
        for table in (requests, leases):
            connection.execute(sa.delete(table).where(table.c.uid.in_(over)))

    def _forget_old(self, connection: sa.Connection) -> bool:
        more = delete_some(connection, sessions, sessions.c.end_time < clock.now() - self._retention)
        alive = sa.select(sessions.c.uid).where(sessions.c.end_time.is_(None))
        return delete_some(connection, requests, requests.c.uid.not_in(alive)) or more


def _row(record: SessionRecord) -> dict:
    session = record.session
    return {
        "uid": record.uid,
        "id": record.id,
        "server_id": record.server_id,
        "request_id": record.request_id,
        "owner": record.owner,
        "state": session.state,
        "labels": dict(session.labels),
        "create_time": record.create_time,
        "expire_time": session.expire_time.ToNanoseconds() / 1e9 if session.HasField("expire_time") else None,
        "end_time": record.end_time,
        "message": session.SerializeToString(),
        "reason": None if record.reason is None else record.reason.SerializeToString(),
        "epoch": record.epoch,
    }


def record_of(row: sa.Row) -> SessionRecord:
    """The record of a row of ``sessions``."""
    reason = None if row.reason is None else pb.ErrorDetail.FromString(row.reason)
    return SessionRecord(
        row.server_id,
        pb.Session.FromString(row.message),
        request_id=row.request_id,
        uid=row.uid,
        reason=reason,
        end_time=row.end_time,
        owner=row.owner,
        epoch=row.epoch,
    )

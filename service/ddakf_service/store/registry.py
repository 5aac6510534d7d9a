"""The register of sessions, live and past: what a server needs to have them again after a restart."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from time import monotonic

import sqlalchemy as sa
from ddakf_api.v1 import tracking_pb2 as pb

from .database import Database
from .session_record import SessionRecord
from .tables import requests, sessions

_CAPACITY = 10_000  # sessions that wait for a database that cannot be reached
_LOOK_INTERVAL = 0.005  # seconds between looks whether something is written
_MAX_REQUESTS = 256  # creation requests that wait likewise; each may have megabytes of meshes


class Registry:
    """Sessions in the database. Saving never waits; what was saved is known to :meth:`newest` at once.

    Args:
        keep: seconds for which sessions that have ended are remembered.
    """

    def __init__(self, database: Database, keep: float):
        self._database, self._keep = database, keep
        self._requests = database.queue(_MAX_REQUESTS, self._write_requests)
        self._records = database.queue(_CAPACITY, self._write_records)
        database.chore(self._forget_old)

    def save(self, record: SessionRecord) -> None:
        """Registers a session, or what has changed of it: a new state, limits, statistics.

        Only the newest record of a session is written, a few times per second at most; to save at every change is fine.
        """
        self._records.put(record.uid, record)

    async def written(self, uid: int, timeout: float) -> bool:
        """Whether what was saved of a session is in the database: as soon as it is, or after ``timeout`` seconds."""
        deadline = monotonic() + timeout
        with self._database.hurried():
            while uid in self._records:
                if monotonic() > deadline or self._database.condition.problem:
                    return False
                await asyncio.sleep(_LOOK_INTERVAL)
        return True

    def save_request(self, uid: int, request: bytes) -> None:
        """Keeps what a session was created from (a serialised CreateSessionRequest or RestoreSessionRequest), while it
        lives, for a restart before its first checkpoint."""
        self._requests.put(uid, (uid, request))

    def end(self, record: SessionRecord, reason: pb.ErrorDetail) -> None:
        """Registers the end of a session; its history stays."""
        self._requests.discard(record.uid)
        self.save(replace(record, reason=reason, end_time=time.time()))

    async def alive(self, server_id: str) -> list[SessionRecord]:
        """The sessions of a server that have not ended, oldest first; whether one has expired meanwhile is for the
        caller to see from its ``expire_time``.

        Raises:
            Unavailable: the database cannot be reached; worth another try later.
        """
        query = (
            sa.select(sessions)
            .where(sessions.c.server_id == server_id, sessions.c.end_time.is_(None))
            .order_by(sessions.c.create_time)
        )
        return await self._database.read(lambda c: [_record(row) for row in c.execute(query)])

    async def request(self, uid: int) -> bytes | None:
        """What :meth:`save_request` kept, or None.

        Raises:
            Unavailable: the database cannot be reached.
        """
        waiting = self._requests.pending().get(uid)
        if waiting is not None:
            return waiting[1]
        query = sa.select(requests.c.request).where(requests.c.uid == uid)
        return await self._database.read(lambda c: c.execute(query).scalar_one_or_none())

    async def newest(self, session_id: str) -> SessionRecord | None:
        """The last session that had this id, live or past; None where none is remembered.

        Raises:
            Unavailable: the database cannot be reached.
        """
        waiting = [record for record in self._records.pending().values() if record.id == session_id]
        query = sa.select(sessions).where(sessions.c.id == session_id).order_by(sessions.c.create_time.desc()).limit(1)
        stored = await self._database.read(lambda c: [_record(row) for row in c.execute(query)])
        # The waiting record of a session is newer than the stored one of the same, so it comes last.
        return max(reversed([*stored, *waiting]), key=lambda record: record.create_time, default=None)

    def _write_requests(self, connection: sa.Connection, rows: list[tuple[int, bytes]]) -> None:
        values = [{"uid": uid, "request": request} for uid, request in rows]
        connection.execute(self._database.upsert(requests), values)

    def _write_records(self, connection: sa.Connection, records: list[SessionRecord]) -> None:
        connection.execute(self._database.upsert(sessions), [_row(record) for record in records])
        ended = [record.uid for record in records if record.reason is not None]
        connection.execute(sa.delete(requests).where(requests.c.uid.in_(ended)))

    def _forget_old(self, connection: sa.Connection) -> None:
        connection.execute(sa.delete(sessions).where(sessions.c.end_time < time.time() - self._keep))
        alive = sa.select(sessions.c.uid).where(sessions.c.end_time.is_(None))
        connection.execute(sa.delete(requests).where(requests.c.uid.not_in(alive)))


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
    }


def _record(row: sa.Row) -> SessionRecord:
    reason = None if row.reason is None else pb.ErrorDetail.FromString(row.reason)
    return SessionRecord(
        row.server_id,
        pb.Session.FromString(row.message),
        request_id=row.request_id,
        uid=row.uid,
        reason=reason,
        end_time=row.end_time,
        owner=row.owner,
    )

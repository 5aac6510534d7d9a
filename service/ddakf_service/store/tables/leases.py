"""Leases: the gateway that serves each session, where several servers share sessions in one PostgreSQL.

A lease is valid while the row of its gateway is: one heartbeat renews all leases of a gateway. Each change of the gateway
increases the lease's epoch, which fences what an earlier gateway still writes. All times are of the database's clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import sqlalchemy as sa
from ddakf_api.v1 import tracking_pb2 as pb
from sqlalchemy.dialects.postgresql import insert

from .database import Database
from .registry import record_of
from .schema import gateways, leases, sessions
from .session_record import SessionRecord

CHANNEL = "ddakf_leases"  # of notifications, each with the id of a gateway whose leases have changed
_QUOTA_LOCK = 20_733  # any number that no other lock of two keys has
_NOW = sa.extract("epoch", sa.func.clock_timestamp())
_SERVING = sa.and_(leases.c.gateway == gateways.c.id, gateways.c.expire_time > _NOW)


class Lease(NamedTuple):
    """The lease of a session.

    Attributes:
        id, uid: of the session.
        owner: id of the key that owns the session; None: no key.
        gateway: ``server_id`` of its server; empty: it was released.
        address: at which clients reach the gateway; may be empty.
        epoch: number of the lease, larger than that of any earlier lease of the session.
        wanted_by: gateway that asks for the session; empty: none.
        takeover: whether the session's stream should end for it.
        served: the lease is valid.
    """

    id: str
    uid: int
    owner: str | None
    gateway: str
    address: str
    epoch: int
    wanted_by: str
    takeover: bool
    served: bool


class Leases:
    """The leases, as one gateway reads and changes them. All methods raise ``Unavailable`` without a database.

    Args:
        gateway: ``server_id`` of this server.
    """

    def __init__(self, database: Database, gateway: str):
        self._database, self.gateway = database, gateway

    async def claim(
        self,
        session_id: str,
        uid: int,
        owner: str | None,
        request_id: str = "",
        require_room: Callable[[int], None] = lambda count: None,
    ) -> int | None:
        """Takes the lease of a new session; returns its epoch. None: a session of this id, or of this request, exists.

        Args:
            require_room: called with the number of live sessions of the key, which no other claim changes meanwhile; what it
                raises ends the claim.
        """
        request = _request(owner, request_id) if request_id else None
        values = {"id": session_id, "uid": uid, "owner": owner, "gateway": self.gateway, "epoch": 1, "request": request}
        claim = insert(leases).values(values).on_conflict_do_nothing().returning(leases.c.epoch)

        def change(connection: sa.Connection) -> int | None:
            if owner is not None:
                connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_QUOTA_LOCK, sa.func.hashtext(owner))))
                count = sa.select(sa.func.count()).select_from(leases).where(leases.c.owner == owner)
                require_room(connection.execute(count).scalar_one())
            return connection.execute(claim).scalar_one_or_none()

        return await self._database.read(change)

    async def find(self, session_id: str) -> Lease | None:
        """The lease of a session; None: there is no live session of this id."""
        found = await self._database.read(lambda c: _read(c, leases.c.id == session_id))
        return found[0] if found else None

    async def of_request(self, owner: str | None, request_id: str) -> Lease | None:
        """The lease of the session that a request of a key has created, or creates now."""
        found = await self._database.read(lambda c: _read(c, leases.c.request == _request(owner, request_id)))
        return found[0] if found else None

    async def take(self, lease: Lease) -> int | None:
        """Takes a lease that nobody serves; returns the new epoch. None: it has changed, or is served."""
        return await self._database.read(lambda c: self._take(c, lease))

    def _take(self, connection: sa.Connection, lease: Lease) -> int | None:
        if lease.gateway not in ("", self.gateway):
            # Locked, so that a heartbeat on its way comes before this transaction, or finds its row expired after it.
            locked = sa.select(gateways.c.expire_time > _NOW).where(gateways.c.id == lease.gateway).with_for_update(read=True)
            if connection.execute(locked).scalar_one_or_none():
                return None
        change = sa.update(leases).where(
            leases.c.id == lease.id, leases.c.epoch == lease.epoch, leases.c.gateway == lease.gateway
        )
        values = {"gateway": self.gateway, "epoch": lease.epoch + 1, "wanted_by": "", "takeover": False}
        return connection.execute(change.values(values).returning(leases.c.epoch)).scalar_one_or_none()

    async def ask(self, lease: Lease, takeover: bool) -> None:
        """Asks the gateway of a lease to hand the session over to this one."""
        await self._change(lease, {"wanted_by": self.gateway, "takeover": takeover}, tell=lease.gateway)

    async def refuse(self, lease: Lease) -> None:
        """Declines to hand a session over."""
        await self._change(lease, {"wanted_by": "", "takeover": False}, tell=lease.wanted_by)

    async def release(self, uid: int, epoch: int) -> None:
        """Gives up the lease of a session, which any gateway may then take; not that of a later session of its id."""

        def change(connection: sa.Connection) -> None:
            released = sa.update(leases).where(leases.c.uid == uid, leases.c.epoch == epoch, leases.c.gateway == self.gateway)
            wanted_by = connection.execute(released.values(gateway="").returning(leases.c.wanted_by)).scalar_one_or_none()
            _tell(connection, wanted_by)

        await self._database.read(change)

    async def drop(self, uid: int) -> None:
        """Deletes the lease of a session that could not be created."""
        await self._database.read(lambda c: c.execute(sa.delete(leases).where(leases.c.uid == uid)))

    async def another_gateway(self) -> str:
        """The address of the gateway with the fewest sessions, other than this one; empty: none has an address."""
        n_sessions = sa.select(sa.func.count()).where(leases.c.gateway == gateways.c.id).scalar_subquery()
        query = sa.select(gateways.c.address).where(
            gateways.c.id != self.gateway, gateways.c.expire_time > _NOW, ~gateways.c.draining, gateways.c.address != ""
        )
        return await self._database.read(lambda c: c.execute(query.order_by(n_sessions).limit(1)).scalar_one_or_none() or "")

    async def own_sessions(self) -> list[SessionRecord]:
        """The sessions whose leases this gateway holds, each with the epoch of its lease, oldest first."""
        query = sa.select(sessions, leases.c.epoch.label("lease_epoch")).join(leases, leases.c.uid == sessions.c.uid)
        query = query.where(leases.c.gateway == self.gateway, sessions.c.end_time.is_(None)).order_by(sessions.c.create_time)
        return await self._database.read(lambda c: [replace(record_of(r), epoch=r.lease_epoch) for r in c.execute(query)])

    async def unleased_sessions(self) -> list[SessionRecord]:
        """The live sessions of this server without a lease: from before it shared them."""
        query = sa.select(sessions).outerjoin(leases, leases.c.uid == sessions.c.uid)
        query = query.where(sessions.c.server_id == self.gateway, sessions.c.end_time.is_(None), leases.c.uid.is_(None))
        return await self._database.read(lambda c: [record_of(row) for row in c.execute(query)])

    async def abandoned(self, count: int) -> list[tuple[Lease, SessionRecord | None]]:
        """Some leases that nobody serves and whose sessions have expired or were never registered."""

        def read(connection: sa.Connection) -> list[tuple[Lease, SessionRecord | None]]:
            over = sa.or_(sessions.c.uid.is_(None), sessions.c.expire_time < _NOW)
            unserved = sa.select(leases.c.id).outerjoin(gateways, _SERVING).outerjoin(sessions, sessions.c.uid == leases.c.uid)
            ids = list(connection.execute(unserved.where(gateways.c.id.is_(None), over).limit(count)).scalars())
            found = _read(connection, leases.c.id.in_(ids))
            rows = connection.execute(sa.select(sessions).where(sessions.c.uid.in_([lease.uid for lease in found])))
            records = {row.uid: record_of(row) for row in rows}
            return [(lease, records.get(lease.uid)) for lease in found]

        return await self._database.read(read)

    async def live_page(self, owner: str | None, after: float, count: int) -> list[SessionRecord]:
        """At most ``count`` live sessions of all gateways, oldest first; one that nobody serves is idle.

        Args:
            owner: of the sessions; None: any.
            after: seconds since 1970; only sessions created at that time or later.
        """
        query = sa.select(sessions, gateways.c.id.is_not(None).label("served")).join(leases, leases.c.uid == sessions.c.uid)
        query = query.outerjoin(gateways, _SERVING).where(sessions.c.end_time.is_(None), sessions.c.create_time >= after)
        query = query if owner is None else query.where(sessions.c.owner == owner)
        query = query.order_by(sessions.c.create_time, sessions.c.id).limit(count)
        return await self._database.read(lambda c: [_listed(row) for row in c.execute(query)])

    async def _change(self, lease: Lease, values: dict, *, tell: str) -> None:
        def change(connection: sa.Connection) -> None:
            connection.execute(sa.update(leases).where(leases.c.id == lease.id, leases.c.epoch == lease.epoch).values(values))
            _tell(connection, tell)

        await self._database.read(change)


def held_by(connection: sa.Connection, gateway: str) -> list[Lease]:
    """The leases of a gateway."""
    return _read(connection, leases.c.gateway == gateway)


def renew(connection: sa.Connection, gateway: str, address: str, seconds: float, draining: bool) -> bool:
    """Renews the row of a gateway, and so its leases. False: it had expired, and other gateways may have taken leases."""
    row = sa.update(gateways).where(gateways.c.id == gateway, gateways.c.expire_time > _NOW)
    values = {"address": address, "expire_time": _NOW + seconds, "draining": draining}
    return connection.execute(row.values(values)).rowcount > 0


def reclaim(connection: sa.Connection, gateway: str, address: str, seconds: float, draining: bool) -> None:
    """Makes the row of a gateway valid again and increases the epochs of the leases that it still has.

    Who takes one of these at the same time and sees the earlier epoch fails.
    """
    values = {"address": address, "expire_time": _NOW + seconds, "draining": draining}
    statement = insert(gateways).values(id=gateway, **values)
    connection.execute(statement.on_conflict_do_update(index_elements=[gateways.c.id], set_=values))
    own = sa.update(leases).where(leases.c.gateway == gateway)
    connection.execute(own.values(epoch=leases.c.epoch + 1, wanted_by="", takeover=False))


def time_of(connection: sa.Connection) -> float:
    """Seconds since 1970, on the database's clock."""
    return float(connection.execute(sa.select(_NOW)).scalar_one())


def withdraw(connection: sa.Connection, gateway: str) -> None:
    """Deletes the row of a gateway that stops: its leases are free."""
    connection.execute(sa.delete(gateways).where(gateways.c.id == gateway))


def _read(connection: sa.Connection, condition: sa.ColumnElement[bool]) -> list[Lease]:
    names = [leases.c[name] for name in ("id", "uid", "owner", "gateway", "epoch", "wanted_by", "takeover")]
    address = sa.func.coalesce(gateways.c.address, "").label("address")
    served = gateways.c.id.is_not(None).label("served")
    query = sa.select(*names, address, served).outerjoin(gateways, _SERVING).where(condition)
    return [Lease(**row) for row in connection.execute(query).mappings()]


def _request(owner: str | None, request_id: str) -> str:
    return f"{owner or ''}:{request_id}"


def _tell(connection: sa.Connection, gateway: str | None) -> None:
    if gateway:
        connection.execute(sa.select(sa.func.pg_notify(CHANNEL, gateway)))


def _listed(row: sa.Row) -> SessionRecord:
    record = record_of(row)
    if not row.served:
        record.session.state = pb.SESSION_STATE_IDLE
    return record

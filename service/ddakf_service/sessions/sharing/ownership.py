"""Shared ownership: a session that a caller names comes to this gateway, if no other one serves its stream."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from dataclasses import replace
from time import monotonic
from weakref import WeakValueDictionary

from ddakf_api.errors import PermissionDenied, ServiceError, SessionBusy, SessionExpired, Unavailable, from_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ...auth.principal import current_principal
from ...background_tasks import BackgroundTasks
from ...observability.metrics import Metrics
from ...store.store import Store
from ...store.tables.heartbeat import Beat
from ...store.tables.leases import Lease
from ...store.tables.session_record import SessionRecord
from ..catalog import SessionCatalog, not_found
from ..lifecycle import Lifecycle
from ..limits.admission import Admission
from ..recovery.durability import Durability
from ..recovery.persistence import Persistence, session_of
from ..recovery.tenure import Tenure
from ..session import Session
from .handover import Handover
from .listing import shared_page

log = logging.getLogger(__name__)

_ANSWER_PATIENCE = 3.0  # seconds, beyond the span of a lease, that a caller waits for the gateway of a session
_LOOK_INTERVAL = 0.1  # seconds between looks at a lease that is awaited
_FIRST_BEAT_PATIENCE = 5.0  # seconds that the start waits for the leases
_MOST_ABANDONED = 100  # sessions that are ended at a time


class SharedOwnership:
    """Sessions of all gateways of one database.

    Args:
        store: with leases.
        span: seconds that a lease is valid without a renewal.
        departure_timeout: seconds that an abandoned session of any gateway waits for its client at least.
    """

    def __init__(
        self,
        store: Store,
        catalog: SessionCatalog,
        persistence: Persistence,
        durability: Durability,
        tasks: BackgroundTasks,
        lifecycle: Lifecycle,
        admission: Admission,
        tenure: Tenure,
        metrics: Metrics,
        *,
        span: float,
        departure_timeout: float,
    ):
        self._store, self._leases, self._catalog = store, store.leases, catalog
        self._persistence, self._lifecycle, self._admission = persistence, lifecycle, admission
        self._handover = Handover(self._leases, catalog, persistence, durability, tasks, lifecycle.depart, tenure, metrics)
        self._moves = metrics.session_moves
        self._patience = span + _ANSWER_PATIENCE
        self._collect_from = monotonic() + departure_timeout  # the clients of a stopped cluster come back within this
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        tenure.until = 0.0
        metrics.lease_held.set_function(lambda: float(tenure.held))

    async def begin(self) -> None:
        loop = asyncio.get_running_loop()

        def on_beat(beat: Beat) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._handover.follow, beat)

        self._store.start_heartbeat(on_beat)
        await self._next_beat(_FIRST_BEAT_PATIENCE)

    async def require(self, name: str) -> None:
        if name.removeprefix("sessions/") in self._catalog:
            self._catalog.changeable(name)
        else:
            await self._require_access(await self._registered(name), change=True)

    async def obtain(self, name: str, *, takeover: bool = False, to_end: bool = False) -> Session:
        await self._bring(name, change=True, to_end=to_end, wait=lambda lease: self._wait_for(lease, takeover))
        return self._catalog.changeable(name)

    async def readable(self, name: str) -> Session:
        await self._bring(name, change=False, wait=self._take_unserved)
        return self._catalog.readable(name)

    async def described(self, name: str) -> Session | SessionRecord:
        if name.removeprefix("sessions/") in self._catalog:
            return self._catalog.readable(name)
        return await self._registered(name)

    async def page(self, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
        return await shared_page(self._leases, self._catalog, request)

    async def successor(self) -> str:
        with contextlib.suppress(Unavailable):
            return await self._leases.another_gateway()
        return ""

    async def leave(self, reason: Callable[[], ServiceError], timeout: float) -> bool:
        moves = [asyncio.ensure_future(self._handover.hand_over(session, reason())) for session in self._catalog]
        if moves:
            _, late = await asyncio.wait(moves, timeout=timeout)
            if late:
                log.error("%d sessions could not be handed over in %g s; others may take them later", len(late), timeout)
        return True

    async def end_abandoned(self) -> None:
        if monotonic() < self._collect_from:
            return
        for lease, record in await self._leases.abandoned(_MOST_ABANDONED):
            if lease.id in self._catalog or (epoch := await self._leases.take(lease)) is None:
                continue
            if record is None:  # its creation was cut off
                await self._leases.drop(lease.uid)
                continue
            session = self._adopt(record, epoch)
            log.info("a session that no server has is ended", extra={"session": session.id})
            self._lifecycle.end(session, SessionExpired(f"{session.name} was left by its client and has expired"))

    async def _bring(self, name: str, *, change: bool, wait: Callable, to_end: bool = False) -> None:
        """Brings a session to this gateway, unless it is here.

        Args:
            change: the caller wants to change it.
            to_end: it needs no room here.
            wait: returns the epoch of the lease, now this gateway's.
        """
        session_id = name.removeprefix("sessions/")
        lock = self._locks.setdefault(session_id, asyncio.Lock())
        async with lock:
            await self._handover.left(session_id)
            await self._lifecycle.wait_closed(session_id)
            if session_id in self._catalog:
                return
            await self._require_access(await self._registered(name), change)
            if not to_end:
                self._admission.require_running("sessions")
                self._admission.require_server_room(len(self._catalog))
            if (lease := await self._leases.find(session_id)) is None:
                raise not_found(name)
            epoch = await wait(lease)
            self._adopt(await self._registered(name), epoch)

    def _adopt(self, record: SessionRecord, epoch: int) -> Session:
        """The session of a lease that this gateway has taken, in its catalog."""
        session = session_of(replace(record, epoch=epoch))
        self._catalog.add(session)
        self._persistence.save(session)
        self._moves.labels("taken").inc()
        return session

    async def _registered(self, name: str) -> SessionRecord:
        """The row of a live session that the caller may read.

        Raises:
            SessionNotFound: no such session; if it has ended, the reason instead. Unavailable: the database cannot be read.
        """
        session_id = name.removeprefix("sessions/")
        record = await self._persistence.newest_record(session_id)
        if record is None or not current_principal.get().may_read(record.owner):
            raise not_found(name)
        if record.reason is not None:
            raise from_detail(record.reason)
        return record

    async def _require_access(self, record: SessionRecord, change: bool) -> None:
        self._catalog.require_admitted()
        if change and not current_principal.get().may_change(record.owner):
            raise PermissionDenied(f"{record.session.name} belongs to another key")

    async def _take_unserved(self, lease: Lease) -> int:
        """Takes a lease that nobody serves; returns its new epoch."""
        if lease.served and lease.gateway != self._leases.gateway:
            raise _elsewhere(lease)
        if (epoch := await self._leases.take(lease)) is None:
            raise Unavailable(f"sessions/{lease.id} moves between servers; try again", retry_after=_LOOK_INTERVAL)
        return epoch

    async def _wait_for(self, lease: Lease, takeover: bool) -> int:
        """Takes a lease as soon as nobody serves it, and asks its gateway for it; returns its new epoch.

        Raises:
            SessionBusy: the gateway refuses. Unavailable: it does not answer. SessionNotFound: the session has ended.
        """
        deadline, asked = monotonic() + self._patience, 0
        while monotonic() < deadline:
            if not lease.served or lease.gateway == self._leases.gateway:
                if (epoch := await self._leases.take(lease)) is not None:
                    return epoch
            elif lease.epoch != asked:
                asked = lease.epoch
                await self._leases.ask(lease, takeover)
            elif lease.wanted_by != self._leases.gateway:
                raise _elsewhere(lease)
            else:
                await self._next_beat(_LOOK_INTERVAL)
            found = await self._leases.find(lease.id)
            if found is None:
                raise not_found(f"sessions/{lease.id}")
            lease = found
        raise Unavailable(f"{_place(lease)}, which does not answer; try again later", retry_after=1.0)

    async def _next_beat(self, timeout: float) -> None:
        """Returns at the next news of the leases, or after a timeout."""
        self._handover.renewed.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self._handover.renewed.wait()


def _elsewhere(lease: Lease) -> SessionBusy:
    return SessionBusy(f"{_place(lease)}, with a stream or its readers: call there, or open a stream with takeover")


def _place(lease: Lease) -> str:
    where = f" at {lease.address}" if lease.address else ""
    return f"sessions/{lease.id} is on the server {lease.gateway!r}{where}"

"""Handover: sessions that leave this gateway, in order or because it has lost their leases."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from time import monotonic

from ddakf_api.errors import ServiceError, StreamTakenOver, Unavailable

from ...background_tasks import BackgroundTasks
from ...observability.metrics import Metrics
from ...store.tables.heartbeat import Beat
from ...store.tables.leases import Lease, Leases
from ..catalog import SessionCatalog
from ..recovery.durability import Durability
from ..recovery.persistence import Persistence
from ..recovery.tenure import Tenure
from ..session import Session

log = logging.getLogger(__name__)

_LEAVE_DETECTION_TIMEOUT = 0.5  # seconds until this server must have noticed that a client has left
_WRITE_TIMEOUT = 5.0  # seconds for the last checkpoint to reach the store
_LONGEST_OPENING = 60.0  # seconds; a lease that is longer without its session was taken for a caller who has left


class Handover:
    """Follows the leases of this gateway and lets sessions go.

    Args:
        depart: removes a session from the catalog and from its worker, see :meth:`..lifecycle.Lifecycle.depart`.

    Attributes:
        renewed: set at each renewal of the leases.
    """

    def __init__(
        self,
        leases: Leases,
        catalog: SessionCatalog,
        persistence: Persistence,
        durability: Durability,
        tasks: BackgroundTasks,
        depart: Callable[[Session, ServiceError], None],
        tenure: Tenure,
        metrics: Metrics,
    ):
        self._leases, self._catalog, self._persistence = leases, catalog, persistence
        self._durability, self._tasks, self._depart, self._tenure = durability, tasks, depart, tenure
        self._moves = metrics.session_moves
        self._leaving: dict[str, asyncio.Task[None]] = {}  # by session id
        self._answering: set[int] = set()  # uids
        self._without_session: dict[int, float] = {}  # by uid, since when
        self.renewed = asyncio.Event()

    def follow(self, beat: Beat) -> None:
        """Applies a renewal of the leases: drops lost sessions, answers gateways that ask for one, and releases leases without
        a session, which would count for their keys and never expire."""
        held = {lease.uid: lease for lease in beat.held}
        for session in self._catalog:
            if lease := held.get(session.uid):
                session.epoch = max(session.epoch, lease.epoch)
            elif session.leased_at < beat.began:
                self._lose(session)
        self._tenure.until = max(self._tenure.until, beat.until)
        here = {session.uid for session in self._catalog}
        self._without_session = {uid: self._without_session.get(uid, beat.began) for uid in held.keys() - here}
        for lease in beat.held:
            is_orphaned = beat.began - self._without_session.get(lease.uid, beat.began) > _LONGEST_OPENING
            if (lease.wanted_by or is_orphaned) and lease.uid not in self._answering:
                self._answering.add(lease.uid)
                self._tasks.start(self._answer(lease))
        self.renewed.set()

    async def left(self, session_id: str) -> None:
        """Returns when a session that is leaving has left."""
        if leaving := self._leaving.get(session_id):
            await asyncio.wait({leaving})

    async def hand_over(self, session: Session, reason: ServiceError) -> None:
        """Ends a session's stream, writes its last checkpoint, and releases its lease.

        Args:
            reason: for the stream.
        """
        if (leaving := self._leaving.get(session.id)) is None:
            leaving = self._leaving[session.id] = self._tasks.start(self._hand_over(session, reason))
            leaving.add_done_callback(lambda _: self._leaving.pop(session.id))
        await asyncio.shield(leaving)

    async def _hand_over(self, session: Session, reason: ServiceError) -> None:
        while not session.closed:
            await self._end_stream(session, reason)
            async with session.lock:
                if session.stream is None and not session.closed:  # none was opened meanwhile
                    await self._leave(session)

    async def _end_stream(self, session: Session, reason: ServiceError) -> None:
        stream = session.stream
        if stream is not None:
            stream.end(reason)
            await stream.close()
            if session.stream is stream:
                session.stream, session.departure_time = None, monotonic()

    async def _leave(self, session: Session) -> None:
        """Lets a session go; the caller holds its lock."""
        taking = self._durability.checkpoint(session) if session.has_worker else None
        if taking is not None:
            await taking
        self._depart(session, Unavailable(f"{session.name} has moved to another server; try again", retry_after=0.1))
        if not await self._persistence.leave(session, _WRITE_TIMEOUT):
            log.error("a session goes from an earlier checkpoint: the last one is not written", extra={"session": session.id})
        self._moves.labels("handed_over").inc()
        try:
            await self._leases.release(session.uid, session.epoch)
        except Unavailable as error:
            log.error("a lease could not be released: %s", error, extra={"session": session.id})

    def _lose(self, session: Session) -> None:
        """Drops a session that another gateway has taken. Nothing is written."""
        log.warning("another server has taken a session over", extra={"session": session.id})
        self._moves.labels("lost").inc()
        reason = StreamTakenOver(f"another server took over {session.name}, as this one could not renew its lease")
        if session.stream is not None:
            session.stream.end(reason)
        self._depart(session, Unavailable(f"{session.name} has moved to another server; try again", retry_after=0.1))
        self._persistence.forget(session)

    async def _answer(self, lease: Lease) -> None:
        """Hands a session over to the gateway that asks for it, or refuses; without the session its lease is released, but
        not before the end of a session that has ended is written: another gateway would bring the session back."""
        try:
            session = next(iter(self._catalog.live([lease.id])), None)
            if session is None or session.uid != lease.uid:  # it was taken by a caller who has left
                await self.left(lease.id)
                if await self._persistence.written(lease.uid):  # its end, if any, which deletes the lease
                    await self._leases.release(lease.uid, lease.epoch)
            elif lease.takeover or await self._is_left(session):
                await self.hand_over(session, StreamTakenOver(f"another stream took over {session.name}"))
            else:
                await self._leases.refuse(lease)
        except Unavailable as error:
            log.warning("a server that asks for a session gets no answer: %s", error, extra={"session": lease.id})
        finally:
            self._answering.discard(lease.uid)

    async def _is_left(self, session: Session) -> bool:
        """Whether a session has no stream, or one that ends now: its client has left."""
        deadline = monotonic() + _LEAVE_DETECTION_TIMEOUT
        while session.stream is not None and monotonic() < deadline:
            await asyncio.sleep(_LEAVE_DETECTION_TIMEOUT / 10)
        return session.stream is None

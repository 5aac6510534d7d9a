"""Tracker access: exclusive access of a call to a session's tracker, after a restore where its worker was lost."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

from ddakf_api.errors import ServiceError, Unavailable

from ..session import Session
from .tenure import Tenure

_LEASE_TIMEOUT = 5.0  # seconds that a call waits for the renewal of the leases
_WORKER_TIMEOUT = 5.0  # seconds that a call waits for a restore: less than the timeout of clients


class TrackerAccess:
    """Exclusive access for calls. Frames of a stream wait longer; see :class:`~ddakf_service.streaming.stream.Stream`.

    Args:
        require_live: raises the reason of a session that has ended, see :meth:`.catalog.SessionCatalog.require_live`.
        revive: starts the restore of a session, see :meth:`.durability.Durability.revive`.
        tenure: whether this server may use its sessions.
    """

    def __init__(
        self,
        require_live: Callable[[Session], None],
        revive: Callable[[Session], asyncio.Task[ServiceError | None]],
        tenure: Tenure,
    ):
        self._require_live, self._revive, self._tenure = require_live, revive, tenure

    @contextlib.asynccontextmanager
    async def exclusive(self, session: Session) -> AsyncIterator[None]:
        """Context in which the session has a worker and is locked.

        Raises:
            SessionNotFound: the session has ended meanwhile. Unavailable: the restore took too long.
        """
        session.touch()  # a client that gets Unavailable has returned too
        while True:
            await self.wait_for_lease(session)  # without one an earlier call or frame may keep the lock
            if not session.has_worker:
                await self._wait_for_worker(session)
            async with session.lock:
                self._require_live(session)
                await self._tenure.wait(session, _LEASE_TIMEOUT)
                if session.has_worker:  # still
                    session.touch()
                    yield
                    return

    async def wait_for_lease(self, session: Session) -> None:
        """Returns when this server may answer for a live session. Raises as :meth:`.Tenure.wait`, after a timeout."""
        self._require_live(session)
        await self._tenure.wait(session, _LEASE_TIMEOUT)

    async def _wait_for_worker(self, session: Session) -> None:
        """Waits for the session's restore, which continues after a timeout.

        Raises:
            Unavailable: the restore takes longer.
        """
        restore = self._revive(session)
        await asyncio.wait({restore}, timeout=_WORKER_TIMEOUT)
        if not restore.done():
            raise Unavailable(f"{session.name} waits for a worker; try again later", retry_after=_WORKER_TIMEOUT)
        reason = restore.result()
        if reason and not session.closed:  # the catalog has the reason of an ended session
            raise reason

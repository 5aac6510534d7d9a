"""A turn of a session in its worker, which it is given back before where it has lost it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from ddakf_api.errors import Unavailable

from .catalog import SessionCatalog, not_found
from .durability import Durability
from .session import Session

_WORKER_PATIENCE = 5.0  # seconds that a call waits for its session to have a worker: less than clients wait for an answer


class TrackerAccess:
    """Where sessions have their turns. Their streams' frames wait longer, see :class:`.stream.Stream`."""

    def __init__(self, catalog: SessionCatalog, durability: Durability):
        self._catalog, self._durability = catalog, durability

    @contextlib.asynccontextmanager
    async def of(self, session: Session) -> AsyncIterator[None]:
        """The turn of a call: the session has a worker, and is locked.

        Raises:
            SessionNotFound: it has ended meanwhile. Unavailable: it has had no worker for too long.
        """
        while True:
            if not session.seated:
                await self._seated_in_time(session)
            async with session.lock:
                if self._catalog.readable(session.name) is not session:  # it ended meanwhile, and another has its name
                    raise not_found(session.name)
                if session.seated:  # still
                    session.touch()
                    yield
                    return

    async def _seated_in_time(self, session: Session) -> None:
        """Has the session restored, which goes on even where this gives up, so that its caller has an answer.

        Raises:
            Unavailable: it takes longer.
        """
        reviving = self._durability.revive(session)
        await asyncio.wait({reviving}, timeout=_WORKER_PATIENCE)
        if not reviving.done():
            raise Unavailable(f"{session.name} waits for a worker; try again later", retry_after=_WORKER_PATIENCE)
        reason = reviving.result()
        if reason and not session.closed:  # of one that has ended the catalog knows why
            raise reason

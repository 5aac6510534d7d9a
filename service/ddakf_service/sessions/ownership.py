"""Ownership: where the sessions are that a caller names. Here: all on this server. Shared ones: :mod:`.sharing.ownership`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from ddakf_api.errors import ServiceError
from ddakf_api.v1 import tracking_pb2 as pb

from ..store.tables.session_record import SessionRecord
from .catalog import SessionCatalog
from .session import Session


class Ownership(Protocol):
    """Access to sessions by name. Each method raises as :meth:`.catalog.SessionCatalog.changeable` or ``readable``."""

    async def begin(self) -> None:
        """Called at the start of the server, before it loads its earlier sessions."""

    async def require(self, name: str) -> None:
        """Checks that the caller may change a session, on whichever server it is."""

    async def obtain(self, name: str, *, takeover: bool = False, to_end: bool = False) -> Session:
        """A session that the caller may change, on this server from now on.

        Args:
            takeover: also one with a stream on another server, which ends.
            to_end: the caller ends it, which a full or stopping server does too.

        Raises:
            SessionBusy: it has a stream on another server. Unavailable: the other server does not answer.
        """

    async def readable(self, name: str) -> Session:
        """A session on this server that the caller may read. Raises ``SessionBusy`` for one on another server."""

    async def described(self, name: str) -> Session | SessionRecord:
        """A live session that the caller may read, or its row where another server has it."""

    async def page(self, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
        """One page of live sessions, oldest first. Raises as :meth:`.catalog.SessionCatalog.page`."""

    async def successor(self) -> str:
        """Address of a server that can go on with the sessions; empty: none is known."""

    async def leave(self, reason: Callable[[], ServiceError], timeout: float) -> bool:
        """Hands the sessions over to other servers; False: no server shares them.

        Args:
            reason: returns the error for a stream.
        """

    async def end_abandoned(self) -> None:
        """Ends expired sessions that no server has."""


class SoleOwnership:
    """Sessions of a server that shares none."""

    def __init__(self, catalog: SessionCatalog):
        self._catalog = catalog

    async def begin(self) -> None:
        return

    async def require(self, name: str) -> None:
        await self.obtain(name)

    async def obtain(self, name: str, *, takeover: bool = False, to_end: bool = False) -> Session:
        await self._catalog.lookup(name)
        return self._catalog.changeable(name)

    async def readable(self, name: str) -> Session:
        return await self._catalog.lookup(name)

    async def described(self, name: str) -> Session:
        return await self._catalog.lookup(name)

    async def page(self, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
        return self._catalog.page(request)

    async def successor(self) -> str:
        return ""

    async def leave(self, reason: Callable[[], ServiceError], timeout: float) -> bool:
        return False

    async def end_abandoned(self) -> None:
        return

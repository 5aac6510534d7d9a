"""Lifecycle: creation of sessions, once per request id, reload of earlier ones, and their end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import OrderedDict
from collections.abc import Awaitable, Callable

from ddakf_api.errors import ServiceError, SessionExists, Unavailable, WorkerLost, from_detail, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ..auth.principal import Principal, current_principal
from ..sessions import admission
from ..workers.pool import Memory, WorkerPool
from .admission import Admission
from .catalog import LOAD_RETRY_INTERVAL, SessionCatalog
from .durability import Durability
from .persistence import Persistence
from .session import Session, take_meshes

log = logging.getLogger(__name__)

OpenSession = Callable[[str, bytes, Memory], Awaitable[bytes]]

_MAX_REQUESTS = 1024  # remembered request ids


class Lifecycle:
    """Creates sessions, reloads those from before the start of the process, and ends them."""

    def __init__(
        self, pool: WorkerPool, admission: Admission, catalog: SessionCatalog, persistence: Persistence, durability: Durability
    ):
        self._pool, self._admission, self._catalog = pool, admission, catalog
        self._persistence, self._durability = persistence, durability
        self._opening: dict[str, str | None] = {}  # id to owner
        self._closing: dict[str, asyncio.Task[None]] = {}  # ended sessions that are still in a worker
        self._requests: OrderedDict[tuple[str | None, str], asyncio.Future[str]] = OrderedDict()  # by owner and request id

    async def create(self, request, open_session: OpenSession) -> pb.Session:
        """Creates a session, or waits for an earlier call with the same request id. The caller's key owns the session."""
        principal = current_principal.get()
        owner, request_id = principal.id or None, request.request_id
        admission.require_request_id(request_id)
        request_key = owner, request_id
        if request_key in self._requests:
            return self._catalog.changeable("sessions/" + await asyncio.shield(self._requests[request_key])).message()
        session_id = self._new_id(request.session_id, principal)
        creation: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        if request_id:
            self._remember(request_key, creation)
        self._opening[session_id] = owner
        try:
            session = await self._open(session_id, request, owner, open_session)
        except BaseException as error:
            self._requests.pop(request_key, None)
            # A copy: the traceback of the error refers to this Python frame, and so to the request.
            is_service_error = isinstance(error, ServiceError)
            copy = from_detail(to_detail(error)) if is_service_error else Unavailable("the first call was cut off")
            creation.set_exception(copy)
            creation.exception()  # marks it as retrieved: asyncio would log it otherwise
            raise
        finally:
            del self._opening[session_id]
        creation.set_result(session_id)
        await self._persistence.wait_registered(session)
        return session.message()

    async def _open(self, session_id: str, request, owner: str | None, open_session: OpenSession) -> Session:
        limits, labels = self._admission.limits(request.session.limits), admission.labels(request.session)
        if closing := self._closing.get(session_id):  # the previous session of this id
            await asyncio.wait({closing})
        memory = self._admission.memory_estimate(request)
        opened = pb.Session.FromString(await open_session(session_id, request.SerializeToString(), memory))
        session = Session(
            session_id, opened, take_meshes(opened), limits, labels=labels, owner=owner, request_id=request.request_id
        )
        self._catalog.add(session)
        self._persistence.register(session)
        self._durability.checkpoint(session)
        log.info("the session was created", extra={"session": session_id, "vertices": opened.garment_vertex_count})
        return session

    def _new_id(self, requested: str, principal: Principal) -> str:
        self._admission.require_running("sessions")
        self._admission.require_room(principal, [*(session.owner for session in self._catalog), *self._opening.values()])
        session_id = admission.session_id(requested)
        if session_id in self._catalog or session_id in self._opening:
            raise SessionExists(f"sessions/{session_id} exists already")
        return session_id

    def _remember(self, request_key: tuple[str | None, str], creation: asyncio.Future[str]) -> None:
        self._requests[request_key] = creation
        while len(self._requests) > _MAX_REQUESTS:
            self._requests.popitem(last=False)

    async def load(self) -> None:
        """Reloads the sessions from before the start of the process. Retries in the background until the database works."""
        if not await self._load():
            self._durability.background(self._load_later())

    async def _load(self) -> bool:
        try:
            sessions = await self._persistence.live_sessions()
        except Unavailable as error:
            log.error("earlier sessions cannot be loaded yet: %s", error)
            return False
        self._catalog.loaded = True
        for session in sessions:
            if session.id not in self._catalog and session.id not in self._opening:
                self._catalog.add(session)
                if session.request_id:
                    self._remember((session.owner, session.request_id), _completed(session.id))
        if sessions:
            log.info("sessions from before the start wait for their clients", extra={"sessions": len(sessions)})
        self._durability.background(self._persistence.delete_stale_checkpoints(lambda: [*sessions, *self._catalog]))
        return True

    async def _load_later(self) -> None:
        await asyncio.sleep(LOAD_RETRY_INTERVAL)
        while not (self._admission.draining or await self._load()):
            await asyncio.sleep(LOAD_RETRY_INTERVAL)

    def end(self, session: Session, reason: ServiceError) -> None:
        """Ends a session. Its stream, its watchers and later calls get the reason. Its worker drops it in the background,
        which a caller that leaves does not cancel."""
        if not session.closed:
            self.release(session, reason)
            self._persistence.end(session, reason)
            closing = self._closing[session.id] = self._durability.background(self._forget(session))
            closing.add_done_callback(lambda _: self._closing.pop(session.id))

    async def wait_closed(self, session: Session) -> None:
        """Returns when the worker has dropped an ended session."""
        if closing := self._closing.get(session.id):
            await asyncio.shield(closing)

    def release(self, session: Session, reason: ServiceError) -> None:
        """Removes the session from this process; it may continue in the store."""
        self._catalog.remove(session, reason)
        session.closed = True
        if session.stream:
            session.stream.end(reason)
        session.watchers.close(reason)

    async def _forget(self, session: Session) -> None:
        async with session.lock:
            with contextlib.suppress(WorkerLost):  # a lost worker took the session with it
                await self._pool.close(session.id)


def _completed(session_id: str) -> asyncio.Future[str]:
    creation = asyncio.get_running_loop().create_future()
    creation.set_result(session_id)
    return creation

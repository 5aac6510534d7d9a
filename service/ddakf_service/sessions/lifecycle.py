"""How sessions begin and end: a request creates one once, an earlier process left some, and an end is final."""

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
from .catalog import LOAD_PAUSE, SessionCatalog
from .durability import Durability
from .persistence import Persistence
from .session import Session, taken_meshes

log = logging.getLogger(__name__)

_Open = Callable[[str, bytes, Memory], Awaitable[bytes]]

_REQUESTS = 1024  # that are remembered, for who asks again


class Lifecycle:
    """Creates sessions, takes back those of before the start, and ends them."""

    def __init__(
        self, pool: WorkerPool, admission: Admission, catalog: SessionCatalog, persistence: Persistence, durability: Durability
    ):
        self._pool, self._admission, self._catalog = pool, admission, catalog
        self._persistence, self._durability = persistence, durability
        self._opening: dict[str, str | None] = {}  # id to owner
        self._leaving: dict[str, asyncio.Task[None]] = {}  # ended ones that are in a worker still
        self._requests: OrderedDict[tuple[str | None, str], asyncio.Future[str]] = OrderedDict()  # by owner and request id

    async def create(self, request, open_: _Open) -> pb.Session:
        """Runs a creation, or waits for the same request's first run. The session belongs to the key of the call."""
        principal = current_principal.get()
        owner, request_id = principal.id or None, request.request_id
        admission.require_request_id(request_id)
        asked = owner, request_id
        if asked in self._requests:
            return self._catalog.mine("sessions/" + await asyncio.shield(self._requests[asked])).message()
        session_id = self._new_id(request.session_id, principal)
        outcome: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        if request_id:
            self._remember(asked, outcome)
        self._opening[session_id] = owner
        try:
            session = await self._open(session_id, request, owner, open_)
        except BaseException as error:
            self._requests.pop(asked, None)
            # Not the error itself, which has this frame, and the request with it.
            known = isinstance(error, ServiceError)
            outcome.set_exception(from_detail(to_detail(error)) if known else Unavailable("the first call was cut off"))
            outcome.exception()  # seen, even where nobody else waits for it
            raise
        finally:
            del self._opening[session_id]
        outcome.set_result(session_id)
        await self._persistence.written(session)
        return session.message()

    async def _open(self, session_id: str, request, owner: str | None, open_: _Open) -> Session:
        limits, labels = self._admission.limits(request.session.limits), admission.labels(request.session)
        if leaving := self._leaving.get(session_id):  # the one before of this id
            await asyncio.wait({leaving})
        opened = pb.Session.FromString(await open_(session_id, request.SerializeToString(), self._admission.memory(request)))
        session = Session(
            session_id, opened, taken_meshes(opened), limits, labels=labels, owner=owner, request_id=request.request_id
        )
        self._catalog.add(session)
        self._persistence.create(session)
        self._durability.checkpoint(session)
        log.info("the session was created", extra={"session": session_id, "vertices": opened.garment_vertex_count})
        return session

    def _new_id(self, wanted: str, principal: Principal) -> str:
        self._admission.require_running("sessions")
        self._admission.require_room(principal, [*(session.owner for session in self._catalog), *self._opening.values()])
        session_id = admission.session_id(wanted)
        if session_id in self._catalog or session_id in self._opening:
            raise SessionExists(f"sessions/{session_id} exists already")
        return session_id

    def _remember(self, asked: tuple[str | None, str], outcome: asyncio.Future[str]) -> None:
        self._requests[asked] = outcome
        while len(self._requests) > _REQUESTS:
            self._requests.popitem(last=False)

    async def load(self) -> None:
        """Takes the sessions back that this server had before its process ended; tries again, in the background, for as long
        as the database cannot be reached."""
        if not await self._load():
            self._durability.background(self._load_later())

    async def _load(self) -> bool:
        try:
            sessions = await self._persistence.alive()
        except Unavailable as error:
            log.error("earlier sessions cannot be had back yet: %s", error)
            return False
        self._catalog.complete = True
        for session in sessions:
            if session.id not in self._catalog and session.id not in self._opening:
                self._catalog.add(session)
                if session.request_id:
                    self._remember((session.owner, session.request_id), _done(session.id))
        if sessions:
            log.info("sessions of before the start wait for their clients", extra={"sessions": len(sessions)})
        self._durability.background(self._persistence.clean(lambda: [*sessions, *self._catalog]))
        return True

    async def _load_later(self) -> None:
        await asyncio.sleep(LOAD_PAUSE)
        while not (self._admission.draining or await self._load()):
            await asyncio.sleep(LOAD_PAUSE)

    def end(self, session: Session, reason: ServiceError) -> None:
        """The session is gone for good; whoever asks for it, and its stream, is told why. Its worker forgets it in the
        background, so that it does even where whoever ended the session has left."""
        if not session.closed:
            self.forsake(session, reason)
            self._persistence.end(session, reason)
            leaving = self._leaving[session.id] = self._durability.background(self._forget(session))
            leaving.add_done_callback(lambda _: self._leaving.pop(session.id))

    async def ended(self, session: Session) -> None:
        """Returns when the worker has forgotten a session that was ended."""
        if leaving := self._leaving.get(session.id):
            await asyncio.shield(leaving)

    def forsake(self, session: Session, reason: ServiceError) -> None:
        """This process has the session no more; it may live on in the store."""
        self._catalog.remove(session, reason)
        session.closed = True
        if session.stream:
            session.stream.end(reason)
        session.watchers.close(reason)

    async def _forget(self, session: Session) -> None:
        async with session.lock:
            with contextlib.suppress(WorkerLost):  # a lost worker took the session with it
                await self._pool.close(session.id)


def _done(session_id: str) -> asyncio.Future[str]:
    outcome = asyncio.get_running_loop().create_future()
    outcome.set_result(session_id)
    return outcome

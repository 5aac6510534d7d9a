"""Lifecycle: creation of sessions, once per request id, reload of earlier ones, and their end."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from time import monotonic
from typing import NamedTuple

from ddakf_api.errors import ServiceError, SessionExists, Unavailable, WorkerLost, from_detail, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ..auth.principal import Principal, current_principal
from ..background_tasks import BackgroundTasks
from ..observability.logs import FailureLog
from ..store.tables.leases import Leases
from ..store.tables.session_record import SessionRecord, new_uid
from ..workers.pool import Memory, WorkerPool
from .catalog import LOAD_RETRY_INTERVAL, SessionCatalog
from .limits import admission
from .limits.admission import Admission
from .recovery.durability import Durability
from .recovery.persistence import Persistence
from .session import Session, take_meshes

log = logging.getLogger(__name__)

OpenSession = Callable[[str, bytes, Memory], Awaitable[bytes]]
Resolve = Callable[[pb.Session], Awaitable[None]]

_MAX_REQUESTS = 1024  # remembered request ids of a key
_CREATION_PATIENCE = 8.0  # seconds that a repeated creation waits for the first one; less than the timeout of clients
_CREATION_LOOK_INTERVAL = 0.1  # seconds between looks at it


class _Identity(NamedTuple):
    """Number of a new session, and epoch of its lease."""

    uid: int
    epoch: int


class Lifecycle:
    """Creates sessions, reloads those from before the start of the process, and ends them.

    Args:
        leases: of the sessions that several servers share; None: this server shares none.
    """

    def __init__(
        self,
        pool: WorkerPool,
        admission: Admission,
        catalog: SessionCatalog,
        persistence: Persistence,
        durability: Durability,
        tasks: BackgroundTasks,
        leases: Leases | None = None,
    ):
        self._pool, self._admission, self._catalog, self._leases = pool, admission, catalog, leases
        self._persistence, self._durability, self._tasks = persistence, durability, tasks
        self._failures = FailureLog(log, "earlier sessions cannot be loaded yet", "earlier sessions are loaded now")
        self._opening: dict[str, str | None] = {}  # id to owner
        self._closing: dict[str, asyncio.Task[None]] = {}  # ended sessions that are still in a worker
        self._requests: dict[str | None, dict[str, asyncio.Future[str]]] = {}  # by owner and request id, the oldest first

    async def create(self, request, open_session: OpenSession, resolve: Resolve | None = None) -> pb.Session:
        """Creates a session, or waits for an earlier call with the same request id. The caller's key owns the session.

        Args:
            resolve: completes the description of a session that is new.
        """
        principal = current_principal.get()
        owner, request_id = principal.id or None, request.request_id
        admission.require_request_id(request_id)
        request_key = owner, request_id
        if request_id in self._requests.get(owner, {}):
            return await self._created_earlier(request_key)
        creation: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        if request_id:
            self._remember(request_key, creation)
        try:
            if earlier := await self._created_elsewhere(request_key):
                creation.set_result(earlier.id)
                return earlier.session
            session = await self._create(request, principal, open_session, resolve)
        except BaseException as error:
            self._requests.get(owner, {}).pop(request_id, None)
            # A copy: the traceback of the error refers to this Python frame, and so to the request.
            is_service_error = isinstance(error, ServiceError)
            copy = from_detail(to_detail(error)) if is_service_error else Unavailable("the first call was cut off")
            creation.set_exception(copy)
            creation.exception()  # marks it as retrieved: asyncio would log it otherwise
            raise
        creation.set_result(session.id)
        await self._persistence.wait_registered(session)
        return session.message()

    async def _created_earlier(self, request_key: tuple[str | None, str]) -> pb.Session:
        """The session of an earlier call to this server. It may have gone to another one."""
        owner, request_id = request_key
        session_id = await asyncio.shield(self._requests[owner][request_id])
        if session_id not in self._catalog and (moved := await self._created_elsewhere(request_key)):
            return moved.session
        return self._catalog.changeable("sessions/" + session_id).message()

    async def _created_elsewhere(self, request_key: tuple[str | None, str]) -> SessionRecord | None:
        """The live session of an earlier call to any of the servers that share sessions; waits while one of them creates it.

        Raises:
            Unavailable: the creation takes longer, or the database cannot be reached.
        """
        if self._leases is None or not request_key[1]:
            return None
        deadline = monotonic() + _CREATION_PATIENCE
        while (lease := await self._leases.of_request(*request_key)) is not None:
            if lease.gateway == self._leases.gateway:
                is_over = lease.id not in self._opening and await self._persistence.written(lease.uid)
            else:
                is_over = not lease.served
            if record := await self._persistence.created_by(*request_key):
                return record
            if is_over and await self._leases.take(lease) is not None:  # the creation failed, or was cut off
                await self._leases.drop(lease.uid)
            elif monotonic() > deadline:
                raise _being_created()
            else:
                await asyncio.sleep(_CREATION_LOOK_INTERVAL)
        return await self._persistence.created_by(*request_key)  # of a lease from before the leases had requests

    async def _create(self, request, principal: Principal, open_session: OpenSession, resolve: Resolve | None) -> Session:
        owner, session_id = principal.id or None, self._new_id(request.session_id, principal)
        self._opening[session_id] = owner
        try:
            if resolve is not None:
                await resolve(request.session)
            async with self._claimed(session_id, principal, request.request_id) as identity:
                return await self._open(session_id, identity, request, owner, open_session)
        finally:
            del self._opening[session_id]

    @contextlib.asynccontextmanager
    async def _claimed(self, session_id: str, principal: Principal, request_id: str) -> AsyncIterator[_Identity]:
        """Context in which a new session has the lease of its id; without the session it has none afterwards."""
        uid, owner = new_uid(), principal.id or None
        if self._leases is None:
            yield _Identity(uid, 0)
            return
        epoch = await self._claim(session_id, uid, principal, request_id)
        if epoch is None and await self._ends_here(session_id):
            epoch = await self._claim(session_id, uid, principal, request_id)
        if epoch is None:
            is_created = request_id and await self._leases.of_request(owner, request_id)
            raise _being_created() if is_created else _exists(session_id)
        try:
            yield _Identity(uid, epoch)
        except BaseException:
            self._tasks.start(self._disclaim(uid))
            raise

    async def _claim(self, session_id: str, uid: int, principal: Principal, request_id: str) -> int | None:
        """See :meth:`.Leases.claim`. A caller that leaves meanwhile leaves no lease, although the database goes on."""
        has_room = functools.partial(self._admission.require_key_room, principal)
        claim = self._tasks.start(
            self._leases.claim(session_id, uid, principal.id or None, request_id, require_room=has_room)
        )
        try:
            return await asyncio.shield(claim)
        except asyncio.CancelledError:
            self._tasks.start(self._disclaim(uid, claim))
            raise
        finally:
            del claim  # the traceback of its error refers to this Python frame: a reference cycle

    async def _disclaim(self, uid: int, claim: asyncio.Task[int | None] | None = None) -> None:
        with contextlib.suppress(Unavailable):  # the lease expires with this server, and is deleted then
            if claim is not None:
                await claim
            await self._leases.drop(uid)

    async def _ends_here(self, session_id: str) -> bool:
        """Whether the session of a lease has ended on this server; returns when its lease is deleted."""
        lease = await self._leases.find(session_id)
        return lease is None or (lease.gateway == self._leases.gateway and await self._persistence.written(lease.uid))

    async def _open(self, session_id: str, identity: _Identity, request, owner: str | None, open_session: OpenSession) -> Session:
        admission.require_no_name(request.session)
        limits, labels = self._admission.limits(request.session.limits), admission.labels(request.session)
        if closing := self._closing.get(session_id):  # the previous session of this id
            await asyncio.wait({closing})
        memory = self._admission.memory_estimate(request)
        opened = pb.Session.FromString(await open_session(session_id, request.SerializeToString(), memory))
        session = Session(
            session_id,
            opened,
            take_meshes(opened),
            limits,
            labels=labels,
            statistics=pb.SessionStatistics(last_capture_time=opened.statistics.last_capture_time),
            owner=owner,
            request_id=request.request_id,
            uid=identity.uid,
            epoch=identity.epoch,
        )
        await self._count_memory(session)
        self._catalog.add(session)
        self._persistence.register(session)
        self._durability.checkpoint(session)
        fields = {"session": session_id, "vertices": opened.garment_vertex_count, "key": owner or "-"}
        log.info("the session was created", extra=fields)
        return session

    async def _count_memory(self, session: Session) -> None:
        """Counts what an opened session needs: how much a snapshot unfolds to is not known before."""
        try:
            self._pool.count_memory(session.id, session.memory)
        except BaseException:
            await self._pool.close(session.id)
            raise

    def _new_id(self, requested: str, principal: Principal) -> str:
        self._admission.require_running("sessions")
        self._admission.require_room(principal, [*(session.owner for session in self._catalog), *self._opening.values()])
        session_id = admission.session_id(requested)
        if session_id in self._catalog or session_id in self._opening:
            raise _exists(session_id)
        return session_id

    def _remember(self, request_key: tuple[str | None, str], creation: asyncio.Future[str]) -> None:
        owner, request_id = request_key
        of_owner = self._requests.setdefault(owner, {})
        of_owner[request_id] = creation
        if len(of_owner) > _MAX_REQUESTS:
            del of_owner[next(iter(of_owner))]

    async def load(self) -> None:
        """Reloads the sessions from before the start of the process. Retries in the background until the database works."""
        if not await self._load():
            self._tasks.start(self._load_later())

    async def _load(self) -> bool:
        try:
            sessions = await self._persistence.live_sessions()
        except Unavailable as error:
            self._failures.fails(error)
            return False
        self._failures.works()
        self._catalog.loaded = True
        live = {session.id: session.uid for session in self._catalog}
        for session in sessions:
            if session.id in live:
                if session.uid != live[session.id]:
                    self._persistence.end(session, _replaced(session.id))
            elif session.id not in self._opening:
                self._catalog.add(session)
                if session.request_id:
                    self._remember((session.owner, session.request_id), _completed(session.id))
        if sessions:
            log.info("sessions from before the start wait for their clients", extra={"sessions": len(sessions)})
        self._tasks.start(self._persistence.delete_stale_checkpoints(lambda: [*sessions, *self._catalog]))
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
            self._drop(session)

    def depart(self, session: Session, reason: ServiceError) -> None:
        """Removes a session that continues on another server. Calls that have it already get the reason."""
        self.release(session, reason)
        self._drop(session)

    def _drop(self, session: Session) -> None:
        """Removes an ended session from its worker, in the background."""
        closing = self._closing[session.id] = self._tasks.start(self._forget(session))
        closing.add_done_callback(lambda _: self._closing.pop(session.id, None))

    async def wait_closed(self, session_id: str) -> None:
        """Returns when the worker has dropped an ended session."""
        if closing := self._closing.get(session_id):
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


def _exists(session_id: str) -> SessionExists:
    return SessionExists(f"sessions/{session_id} exists already")


def _replaced(session_id: str) -> SessionExists:
    """The reason for the end of a stored session whose id was given again before the database could be read."""
    return SessionExists(f"sessions/{session_id} was created anew while its server could not reach the database")


def _being_created() -> Unavailable:
    return Unavailable("the session of this request is being created; try again", retry_after=_CREATION_LOOK_INTERVAL)


def _completed(session_id: str) -> asyncio.Future[str]:
    creation = asyncio.get_running_loop().create_future()
    creation.set_result(session_id)
    return creation

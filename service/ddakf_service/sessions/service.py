"""Session service: the operations on sessions that all transports share, from creation to end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence, Set
from time import monotonic

from ddakf_api.errors import Draining, FailedPrecondition, InvalidArgument, ServiceError, SessionNotFound, WorkerLost
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.version import require_compatible

from ..auth.principal import current_principal
from ..background_tasks import BackgroundTasks
from ..observability.logs import FailureLog
from ..observability.metrics import Metrics
from ..settings import Settings
from ..store.store import Store
from ..store.tables.session_record import SessionRecord
from ..workers.pool import WorkerPool
from .catalog import SessionCatalog, revoked
from .components import SessionComponents
from .lifecycle import Lifecycle
from .limits import admission
from .limits.admission import Admission
from .limits.penalties import Penalties
from .meshes import Meshes
from .ownership import Ownership, SoleOwnership
from .past import asks_for_past, past_page
from .recovery.durability import Durability
from .recovery.persistence import Persistence
from .recovery.tenure import Tenure
from .recovery.tracker_access import TrackerAccess
from .session import Session
from .sharing.ownership import SharedOwnership

log = logging.getLogger(__name__)

_EXPIRY_INTERVAL = 1.0  # seconds between checks for expired sessions
_ABANDONED_INTERVAL = 10.0  # seconds between looks for sessions that no server has
_LAST_CHECKPOINTS_TIMEOUT = 10.0  # seconds that the last checkpoints may take
_CHANGEABLE = ("labels", "limits", "config_json", "fabric")
_UNLISTED = ("config_json", "vertex_map")  # kilobytes of a session, which is read alone for them


class Sessions:
    """All sessions of this server; runs in the event loop and never computes.

    Args:
        pool: the workers. Its ``on_lost`` should be :meth:`lose`.
        store: durable state, opened.

    Attributes:
        components: shared with the streams.
        meshes: uploaded meshes, which new sessions may use.
    """

    def __init__(self, pool: WorkerPool, settings: Settings, metrics: Metrics, store: Store):
        self._pool, self._settings, self._store = pool, settings, store
        self._admission = Admission(settings)
        tenure = Tenure()
        self._persistence = Persistence(
            store.registry, store.history, store.checkpoints, store.server_id, store.require_name, tenure, store.leases
        )
        self._catalog = catalog = SessionCatalog(self._persistence.newest_record)
        self._tasks = tasks = BackgroundTasks()
        self._durability = Durability(
            pool, self._persistence, metrics, settings.checkpoint_every, self._give_up, tenure, tasks
        )
        self._tracker_access = TrackerAccess(catalog.require_live, self._durability.revive, tenure)
        self.meshes = Meshes(store.meshes, settings)
        self._lifecycle = Lifecycle(pool, self._admission, catalog, self._persistence, self._durability, tasks, store.leases)
        self._ownership = self._ownership_with(tenure, metrics)
        self._tenure, self._abandoned_due = tenure, 0.0
        self._failures = FailureLog(log, "abandoned sessions cannot be ended", "abandoned sessions can be ended again")
        self.components = SessionComponents(
            pool,
            settings,
            self._admission,
            catalog,
            self._persistence,
            self._durability,
            Penalties(settings, pool, metrics, self._give_up),
            self._tracker_access,
            self._ownership,
            tasks,
        )
        metrics.sessions.set_function(lambda: len(catalog))
        metrics.streams.set_function(lambda: sum(session.stream is not None for session in catalog))
        metrics.watchers.set_function(lambda: sum(len(session.watchers) for session in catalog))

    def _ownership_with(self, tenure: Tenure, metrics: Metrics) -> Ownership:
        if self._store.leases is None:
            return SoleOwnership(self._catalog)
        return SharedOwnership(
            self._store,
            self._catalog,
            self._persistence,
            self._durability,
            self._tasks,
            self._lifecycle,
            self._admission,
            tenure,
            metrics,
            span=self._settings.lease_seconds,
            departure_timeout=self._settings.departure_timeout,
        )

    @property
    def draining(self) -> bool:
        """Whether the server is about to stop and accepts no sessions or streams."""
        return self._admission.draining

    def _give_up(self, session: Session, reason: ServiceError) -> None:
        self._lifecycle.end(session, reason)

    async def create(self, request: pb.CreateSessionRequest) -> pb.Session:
        """Creates a session, or returns the one that the same request id created. The caller's key owns it."""
        require_compatible(request.api_version, peer="client")
        return await self._lifecycle.create(request, self._pool.open, self.meshes.resolve)

    async def restore(self, request: pb.RestoreSessionRequest) -> pb.Session:
        """Creates a session from a snapshot."""
        require_compatible(request.api_version, peer="client")
        return await self._lifecycle.create(request, self._pool.import_snapshot)

    async def load(self) -> None:
        """Reloads the sessions from before the start of the process. Retries in the background until the database works."""
        await self._ownership.begin()
        await self._lifecycle.load()

    async def get(self, name: str, view: pb.SessionView = pb.SESSION_VIEW_BASIC) -> pb.Session:
        if view not in pb.SessionView.values():
            raise InvalidArgument(field="view", expected="SESSION_VIEW_BASIC or SESSION_VIEW_FULL", got=f"the value {view}")
        session = await self._ownership.described(name)
        if isinstance(session, SessionRecord):
            if view == pb.SESSION_VIEW_FULL:
                session.session.MergeFrom(await self._persistence.meshes(session))
            return session.session
        if view == pb.SESSION_VIEW_FULL and session.stored_only:
            async with self._tracker_access.exclusive(session):
                pass
        return session.message(view)

    async def list(self, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
        """One page of the sessions that the caller may read: live ones, oldest first, or ended ones, newest first."""
        past = asks_for_past(request)
        page = await (past_page(self._persistence.ended_records, request) if past else self._ownership.page(request))
        for session in page.sessions:
            for name in _UNLISTED:
                session.ClearField(name)
        return page

    async def update(self, request: pb.UpdateSessionRequest, accepts: Callable[[str], bool] | None = None) -> pb.Session | str:
        """Changes labels, limits, configuration and fabric: all named ones, or none when one is invalid.

        Returns:
            The session; or its etag, where ``accepts`` refuses that and the session stays as it is.
        """
        change, session = request.session, await self._ownership.obtain(request.session.name)
        paths = set(request.update_mask.paths or (f.name for f, _ in change.ListFields() if f.name not in ("name", "etag")))
        if unknown := sorted(paths - set(_CHANGEABLE)):
            raise InvalidArgument(field="update_mask", expected="some of " + ", ".join(_CHANGEABLE), got=repr(unknown[0][:80]))
        labels = admission.labels(change) if "labels" in paths else None
        limits = self._admission.limits(change.limits) if "limits" in paths else None
        async with self._tracker_access.exclusive(session):
            if accepts is not None and not accepts(etag := str(session.revision)):
                return etag
            if change.etag and change.etag != str(session.revision):
                raise FailedPrecondition(
                    f"{session.name} was changed by another call: its etag is {session.revision}, not {change.etag[:80]}",
                    field="etag",
                )
            await self._tasks.complete(self._change(session, change, paths, labels, limits))
        if session.epoch:  # other servers read its etag in the database
            await self._persistence.written(session.uid)
        return session.message()

    async def _change(
        self,
        session: Session,
        change: pb.Session,
        paths: set[str],
        labels: dict[str, str] | None,
        limits: pb.SessionLimits | None,
    ) -> None:
        """Applies a valid change as a whole, or nothing of it."""
        if limits is not None:
            self._pool.count_memory(session.id, session.memory_with(limits))
        try:
            if paths & {"config_json", "fabric"}:
                await self._configure(session, change, paths)
        except BaseException:
            if limits is not None:
                with contextlib.suppress(WorkerLost):  # a lost worker counts nothing
                    self._pool.count_memory(session.id, session.memory)
            raise
        # A field that is not named keeps its present value: another call may have changed it meanwhile.
        session.labels = session.labels if labels is None else labels
        session.limits = session.limits if limits is None else limits
        session.revision += 1
        self._persistence.save(session)

    async def _configure(self, session: Session, change: pb.Session, paths: set[str]) -> None:
        """Applies a new configuration, a new fabric, or both; the fabric overrides the configuration, as at creation."""
        opened, requested = session.description, pb.UpdateSessionRequest(session=pb.Session(name=session.name))
        requested.session.config_json, requested.session.fabric = change.config_json, change.fabric
        requested.update_mask.paths.extend(sorted(paths & {"config_json", "fabric"}))
        answer = pb.Session.FromString(await self._pool.configure(session.id, requested.SerializeToString()))
        await self._durability.checkpoint_now(session)
        session.record_update(requested)
        opened.config_json, opened.fabric = answer.config_json, answer.fabric

    async def reset(self, request: pb.ResetSessionRequest) -> pb.Session:
        """Resets the tracker."""
        session = await self._ownership.obtain(request.name)
        reset_request = request.SerializeToString()
        async with self._tracker_access.exclusive(session):
            await self._tasks.complete(self._reset(session, reset_request))
        return session.message()

    async def _reset(self, session: Session, request: bytes) -> None:
        await self._pool.reset(session.id, request)
        await self._durability.checkpoint_now(session)
        session.record_reset(request)

    async def snapshot(self, name: str) -> pb.SessionSnapshot:
        session = await self._ownership.obtain(name)
        async with self._tracker_access.exclusive(session):
            data = await self._pool.snapshot(session.id, compressed=True)
        return pb.SessionSnapshot(session=session.message(), data=data)

    async def delete(self, name: str, accepts: Callable[[str], bool] | None = None) -> str | None:
        """Ends a session.

        Returns:
            None; or its etag, where ``accepts`` refuses that and the session goes on.
        """
        if accepts is not None and (etag := await self._refused_etag(name, accepts)):
            return etag  # its stream on another server goes on too
        session = await self._ownership.obtain(name, takeover=True, to_end=True)
        if accepts is not None and not accepts(etag := str(session.revision)):
            return etag
        log.info("the session was deleted", extra={"session": session.id, "key": current_principal.get().id or "-"})
        self._lifecycle.end(session, SessionNotFound(f"{session.name} was deleted"))
        await self._lifecycle.wait_closed(session.id)
        if session.epoch:  # other servers read its end in the database
            await self._persistence.written(session.uid)
        return None

    async def _refused_etag(self, name: str, accepts: Callable[[str], bool]) -> str:
        """The etag of a session, wherever it is, if ``accepts`` refuses that; else nothing."""
        await self._ownership.require(name)
        session = await self._ownership.described(name)
        etag = session.session.etag if isinstance(session, SessionRecord) else str(session.revision)
        return "" if accepts(etag) else etag

    async def history(self, request: pb.GetSessionHistoryRequest) -> pb.SessionHistory:
        """History of a live session, else of the newest past session of the name.

        Raises:
            SessionNotFound: no such session. InvalidArgument: an invalid time or number.
            Unavailable: the database cannot be reached.
        """
        session = await self._catalog.newest(request.name)
        if isinstance(session, Session):
            return await self._store.history.query(request, session.uid, session.created)
        return await self._store.history.query(request, session.uid, session.create_time, session.end_time)

    def shut_out(self, key_ids: Set[str]) -> None:
        """Ends the streams and watchers of revoked keys. Their sessions expire after the departure timeout."""
        self._catalog.shut_out(key_ids)
        for session in self._catalog if key_ids else ():
            session.shut_out(key_ids, revoked())

    def lose(self, session_ids: Sequence[str]) -> None:
        """Restores the sessions of a lost worker in another one, those with a stream first."""
        lost = sorted(self._catalog.live(session_ids), key=lambda session: session.stream is None)
        for session in lost:
            session.has_worker = False
        for session in lost:
            self._durability.revive(session)

    async def expire_idle(self) -> None:
        """Ends expired sessions and registers the changes of the others; runs until it is cancelled.

        To be called when the server is ready: the departure timeouts begin now, because no client could return before.
        """
        self._restart_departures()
        while True:
            await asyncio.sleep(_EXPIRY_INTERVAL)
            await self._end_abandoned()
            if self._tenure.held:
                self._expire_or_save()  # a local variable here would hold the last session while it waits

    def _restart_departures(self) -> None:
        for session in self._catalog:
            if session.departure_time is not None:
                session.departure_time = monotonic()

    async def _end_abandoned(self) -> None:
        if monotonic() > self._abandoned_due:
            self._abandoned_due = monotonic() + _ABANDONED_INTERVAL
            try:
                await self._ownership.end_abandoned()
                self._failures.works()
            except Exception as error:
                self._failures.fails(error)

    def _expire_or_save(self) -> None:
        for session in self._catalog:
            try:
                self._expire(session)
                self._persistence.save(session)
            except Exception:  # a failure of one session must not keep the others alive
                log.exception("a session could not be ended", extra={"session": session.id})

    def _expire(self, session: Session) -> None:
        """Ends a session if it has expired."""
        moment, reason = session.expiry()
        if monotonic() > moment:
            log.info("the session expired", extra={"session": session.id})
            self._lifecycle.end(session, reason)

    async def drain(self, grace: float) -> None:
        """Accepts no more sessions, notifies the streams, waits up to ``grace`` seconds for their end, and takes the last
        checkpoints. Shared sessions are then free for other servers."""
        self._admission.draining = True
        self._store.announce_drain()
        message = f"the server stops in {grace:g} s; reconnect later or elsewhere"
        for session in self._catalog:
            session.notify(pb.Notice(kind=pb.NOTICE_KIND_DRAINING, message=message, value=grace))
        deadline = monotonic() + grace
        while any(s.stream for s in self._catalog) and monotonic() < deadline:
            await asyncio.sleep(0.02)
        where = self._settings.successor or await self._ownership.successor()
        for session in self._catalog:
            if session.stream:
                session.stream.notify(_reconnect(where))
                session.stream.end(_stopped())
        if await self._ownership.leave(_stopped, _LAST_CHECKPOINTS_TIMEOUT):
            return
        for session in self._catalog:
            self._tasks.start(self._last_checkpoint(session))
        await self._tasks.settle(_LAST_CHECKPOINTS_TIMEOUT)
        for session in self._catalog:
            self._persistence.save(session)
            self._lifecycle.release(session, _stopped())

    async def _last_checkpoint(self, session: Session) -> None:
        """Takes a checkpoint if frames were applied since the last one; waits for the frame in the worker."""
        async with session.lock:
            if session.has_worker and session.checkpointed_frames != session.statistics.frames_applied:
                self._durability.checkpoint(session)


def _stopped() -> Draining:
    return Draining("the server has stopped; connect again later or elsewhere")


def _reconnect(where: str) -> pb.Notice:
    """The notice to connect again, to an address if it is not empty."""
    message = f"connect again{f' to {where}' if where else ''}; the session waits there"
    return pb.Notice(kind=pb.NOTICE_KIND_RECONNECT, message=message, target=where)

"""Persistence: the sessions of this server in the registry, the history and the checkpoints."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from time import monotonic

from ddakf_api.errors import ServiceError, SessionExpired, Unavailable, WorkerLost, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ...store.files.checkpoints import Checkpoint, Checkpoints
from ...store.tables.history import History
from ...store.tables.leases import Leases
from ...store.tables.registry import Registry
from ...store.tables.session_record import SessionRecord
from ..page_token import Position
from ..session import Session, is_session_id, take_meshes
from .tenure import Tenure

log = logging.getLogger(__name__)

_REGISTRATION_TIMEOUT = 1.0  # seconds that a creation waits for the database
_RETRY_AFTER = 5.0  # seconds, for callers of a session whose checkpoint cannot be read
_UIDS_PER_QUERY = 1000
# Fields of a registered session that :meth:`Session.message` computes from others.
_DERIVED_FIELDS = ("name", "labels", "state", "create_time", "limits", "statistics", "etag", "expire_time", "checkpoint_time")


class Persistence:
    """The sessions of this server in its store. Only coroutines wait.

    Args:
        tenure: whether this server may write checkpoints.
        leases: of the sessions; None: this server shares none.
    """

    def __init__(
        self,
        registry: Registry,
        history: History,
        checkpoints: Checkpoints | None,
        server_id: str,
        require_name: Callable[[], None],
        tenure: Tenure,
        leases: Leases | None = None,
    ):
        self._tenure, self._leases = tenure, leases
        self._registry, self._history, self._checkpoints = registry, history, checkpoints
        self._server_id, self._require_name = server_id, require_name
        self._saved: dict[int, tuple] = {}  # state as registered, by uid

    def register(self, session: Session) -> None:
        """Registers a new session and its creation request, for a restart before the first checkpoint."""
        self.save(session)
        self._registry.save_request(session.uid, session.creation_request().SerializeToString())

    async def wait_registered(self, session: Session) -> None:
        """Returns when the session is in the database, or after a timeout: no creation waits for a failed database."""
        if not await self.written(session.uid):
            log.warning("the session is not registered yet", extra={"session": session.id})

    async def written(self, uid: int) -> bool:
        """Waits until what is registered of a session is in the database; False after a timeout."""
        return await self._registry.written(uid, _REGISTRATION_TIMEOUT)

    async def created_by(self, owner: str | None, request_id: str) -> SessionRecord | None:
        """See :meth:`.Registry.created_by`."""
        return await self._registry.created_by(owner, request_id)

    def save(self, session: Session) -> None:
        """Registers the changes of a live session, if any."""
        if session.closed:
            return
        now = session.state, session.revision, session.checkpoint_number, session.statistics.SerializeToString()
        if self._saved.get(session.uid) != now:
            self._saved[session.uid] = now
            self._registry.save(self._record(session))
            self._history.state(session.uid, session.state)

    def checkpoint(self, session: Session, checkpoint: Checkpoint) -> None:
        if self._checkpoints is not None and self._tenure.held:
            self._checkpoints.save(session.uid, checkpoint._replace(epoch=session.epoch))

    async def leave(self, session: Session, timeout: float) -> bool:
        """Writes what another server needs to go on with a session, and forgets it; False: not all within ``timeout`` seconds."""
        end = monotonic() + timeout
        self._saved.pop(session.uid, None)
        self._registry.save(self._record(session))
        self._history.leave(session.uid)
        has_checkpoint = self._checkpoints is None or await self._checkpoints.written(session.uid, timeout)
        return await self._registry.written(session.uid, max(end - monotonic(), 0.0)) and has_checkpoint

    def forget(self, session: Session) -> None:
        """Forgets a session that another server has taken."""
        self._saved.pop(session.uid, None)
        self._history.leave(session.uid)

    def end(self, session: Session, reason: ServiceError) -> None:
        """Registers the end of a session; its history remains."""
        self._saved.pop(session.uid, None)
        state = pb.SESSION_STATE_EXPIRED if isinstance(reason, SessionExpired) else pb.SESSION_STATE_CLOSED
        record = self._record(session)
        record.session.state = state
        record.session.ClearField("vertex_map")  # of no use without its results, and long
        self._registry.end(record, to_detail(reason))
        self._history.close(session.uid, state)
        if self._checkpoints is not None and self._tenure.held:
            self._checkpoints.delete(session.uid)

    async def newest_record(self, session_id: str) -> SessionRecord | None:
        """The newest session of this id, live or past; None: no such session.

        Raises:
            Unavailable: the database cannot be reached.
        """
        return await self._registry.newest(session_id) if is_session_id(session_id) else None

    async def ended_records(
        self, states: list[int], owner: str | None, before: Position | None, count: int
    ) -> list[SessionRecord]:
        """At most ``count`` ended sessions of any server, newest first; see :data:`..past.EndedRecords`.

        Raises:
            Unavailable: the database cannot be reached.
        """
        return await self._registry.ended(states, owner, before, count)

    async def live_sessions(self) -> list[Session]:
        """The sessions of this server from before the start of the process, without a worker.

        Their departure timeout starts now, as if their clients had just left.

        Raises:
            Unavailable: the database cannot be reached, or another server may have the sessions.
        """
        self._require_name()
        if self._leases is None:
            return [session_of(record) for record in await self._registry.alive(self._server_id)]
        if not self._tenure.held:
            raise Unavailable(
                "the leases of this server's sessions are not renewed yet; try again later", retry_after=_RETRY_AFTER
            )
        for record in await self._leases.unleased_sessions():
            self._registry.end(
                record, to_detail(WorkerLost(f"{record.session.name} ended when its server began to share sessions"))
            )
        return [session_of(record) for record in await self._leases.own_sessions()]

    async def delete_stale_checkpoints(self, sessions: Callable[[], Iterable[Session]]) -> None:
        """Deletes the checkpoints of sessions that have ended.

        Those of sessions that the database does not have stay, and are told: it may be another one, or an older state of it.

        Args:
            sessions: called when the stored checkpoints are known, because sessions may be created meanwhile.
        """
        if self._checkpoints is None:
            return
        try:
            stored = await self._checkpoints.stored()
            unknown = set(stored)
            for begin in range(0, len(stored), _UIDS_PER_QUERY):
                part = stored[begin : begin + _UIDS_PER_QUERY]
                unknown -= set(await self._registry.known_among(part))
                for uid in await self._registry.ended_among(part):
                    self._checkpoints.delete(uid)
            if self._leases is None and (unknown := unknown - {session.uid for session in sessions()}):
                log.warning("%d checkpoints are of sessions that this database does not have; they stay", len(unknown))
        except (OSError, Unavailable) as error:
            log.warning("old checkpoints could not be deleted: %s", error)

    async def meshes(self, record: SessionRecord) -> pb.Session:
        """Garment and body of a registered session, else nothing. Raises ``Unavailable``."""
        request = await self._registry.request(record.uid)
        return pb.Session() if request is None else take_meshes(pb.CreateSessionRequest.FromString(request).session)

    async def newest(self, session: Session) -> Checkpoint | pb.CreateSessionRequest | None:
        """The newest checkpoint of a session, else its creation request; None: neither is stored.

        Raises:
            Unavailable: the store cannot be read now.
        """
        try:
            checkpoint = await self._checkpoints.newest(session.uid) if self._checkpoints is not None else None
            request = await self._registry.request(session.uid) if checkpoint is None else None
        except OSError as error:
            raise Unavailable(
                f"the checkpoints of {session.name} cannot be read now: {error}; try again later", retry_after=_RETRY_AFTER
            ) from error
        return checkpoint if request is None else pb.CreateSessionRequest.FromString(request)

    def _record(self, session: Session) -> SessionRecord:
        message, epoch = session.message(), session.epoch
        return SessionRecord(self._server_id, message, session.request_id, session.uid, owner=session.owner, epoch=epoch)


def session_of(record: SessionRecord) -> Session:
    """A session as registered, without a worker; its departure timeout starts now."""
    message = record.session
    opened = pb.Session()
    opened.CopyFrom(message)
    for field in _DERIVED_FIELDS:
        opened.ClearField(field)
    return Session(
        record.id,
        opened,
        pb.Session(),
        message.limits,
        labels=dict(message.labels),
        statistics=message.statistics,
        revision=int(message.etag),
        created=record.create_time,
        request_id=record.request_id,
        owner=record.owner,
        uid=record.uid,
        epoch=record.epoch,
        has_worker=False,
        stored_only=True,
        departure_time=monotonic(),
    )

"""Persistence: the sessions of this server in the registry, the history and the checkpoints."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from time import monotonic

from ddakf_api.errors import ServiceError, SessionExpired, Unavailable, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ..store.checkpoints import Checkpoints
from ..store.history import History
from ..store.registry import Registry
from ..store.session_record import SessionRecord
from .admission import is_session_id
from .session import Session

log = logging.getLogger(__name__)

_REGISTRATION_TIMEOUT = 1.0  # seconds that a creation waits for the database
_RETRY_AFTER = 5.0  # seconds, for callers of a session whose checkpoint cannot be read
# Fields of a registered session that :meth:`Session.message` computes from others.
_DERIVED_FIELDS = ("name", "labels", "state", "create_time", "limits", "statistics", "etag", "expire_time", "checkpoint_time")


class Persistence:
    """The sessions of this server in its store. Only coroutines wait."""

    def __init__(
        self,
        registry: Registry,
        history: History,
        checkpoints: Checkpoints | None,
        server_id: str,
        require_name: Callable[[], None],
    ):
        self._registry, self._history, self._checkpoints = registry, history, checkpoints
        self._server_id, self._require_name = server_id, require_name
        self._saved: dict[int, tuple] = {}  # state as registered, by uid

    def register(self, session: Session) -> None:
        """Registers a new session and its creation request, for a restart before the first checkpoint."""
        self.save(session)
        self._registry.save_request(session.uid, session.creation_request().SerializeToString())

    async def wait_registered(self, session: Session) -> None:
        """Returns when the session is in the database, or after a timeout: no creation waits for a failed database."""
        if not await self._registry.written(session.uid, _REGISTRATION_TIMEOUT):
            log.warning("the session is not registered yet", extra={"session": session.id})

    def save(self, session: Session) -> None:
        """Registers the changes of a live session, if any."""
        if session.closed:
            return
        now = session.state, session.revision, session.checkpoint_number, session.statistics.SerializeToString()
        if self._saved.get(session.uid) != now:
            self._saved[session.uid] = now
            self._registry.save(self._record(session))
            self._history.state(session.uid, session.state)

    def checkpoint(self, session: Session, snapshot: pb.SessionSnapshot) -> None:
        if self._checkpoints is not None:
            self._checkpoints.save(session.uid, snapshot)

    def end(self, session: Session, reason: ServiceError) -> None:
        """Registers the end of a session; its history remains."""
        self._saved.pop(session.uid, None)
        state = pb.SESSION_STATE_EXPIRED if isinstance(reason, SessionExpired) else pb.SESSION_STATE_CLOSED
        self._registry.end(self._record(session), to_detail(reason))
        self._history.close(session.uid, state)
        if self._checkpoints is not None:
            self._checkpoints.delete(session.uid)

    async def newest_record(self, session_id: str) -> SessionRecord | None:
        """The newest session of this id, live or past; None: no such session.

        Raises:
            Unavailable: the database cannot be reached.
        """
        return await self._registry.newest(session_id) if is_session_id(session_id) else None

    async def live_sessions(self) -> list[Session]:
        """The sessions of this server from before the start of the process, without a worker.

        Their departure timeout starts now, as if their clients had just left.

        Raises:
            Unavailable: the database cannot be reached, or another server may have the sessions.
        """
        self._require_name()
        registered = await self._registry.alive(self._server_id)
        return [_session_of(record) for record in registered]

    async def delete_stale_checkpoints(self, sessions: Callable[[], Iterable[Session]]) -> None:
        """Deletes the checkpoints of all other sessions.

        Args:
            sessions: called when the stored checkpoints are known, because sessions may be created meanwhile.
        """
        if self._checkpoints is not None:
            try:
                await self._checkpoints.keep_only(lambda: [session.uid for session in sessions()])
            except OSError as error:
                log.warning("old checkpoints could not be deleted: %s", error)

    async def newest(self, session: Session) -> pb.SessionSnapshot | pb.CreateSessionRequest | None:
        """The newest checkpoint of a session, else its creation request; None: neither is stored.

        Raises:
            Unavailable: the store cannot be read now.
        """
        try:
            snapshot = await self._checkpoints.newest(session.uid) if self._checkpoints is not None else None
            request = await self._registry.request(session.uid) if snapshot is None else None
        except OSError as error:
            raise Unavailable(
                f"the checkpoints of {session.name} cannot be read now: {error}; try again later", retry_after=_RETRY_AFTER
            ) from error
        return snapshot if request is None else pb.CreateSessionRequest.FromString(request)

    def _record(self, session: Session) -> SessionRecord:
        return SessionRecord(self._server_id, session.message(), session.request_id, session.uid, owner=session.owner)


def _session_of(record: SessionRecord) -> Session:
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
        has_worker=False,
        stored_only=True,
        departure_time=monotonic(),
    )

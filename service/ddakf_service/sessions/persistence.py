"""What of the sessions outlives the process, and how they are had back from it."""

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

_WRITE_PATIENCE = 1.0  # seconds that a creation waits to be registered
_RETRY_AFTER = 5.0  # seconds, told to who asks for a session whose checkpoint cannot be read
# Of a registered session: what is made anew from what else is known whenever it is shown.
_SHOWN = ("name", "labels", "state", "create_time", "limits", "statistics", "etag", "expire_time", "checkpoint_time")


class Persistence:
    """The sessions of this server in its store. Nothing here waits but what is a coroutine."""

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
        self._saved: dict[int, tuple] = {}  # of each session, by uid: what its record says of it

    def create(self, session: Session) -> None:
        """A new session, and what it begins with, until there is a checkpoint of it."""
        self.save(session)
        self._registry.save_request(session.uid, session.beginning().SerializeToString())

    async def written(self, session: Session) -> None:
        """Returns when a restart would know of the session, or when that takes too long: nobody waits for a database that
        does not work."""
        if not await self._registry.written(session.uid, _WRITE_PATIENCE):
            log.warning("the session is not registered yet", extra={"session": session.id})

    def save(self, session: Session) -> None:
        """What has changed of a session that lives, if anything has."""
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
        """The session is no more; its history stays."""
        self._saved.pop(session.uid, None)
        state = pb.SESSION_STATE_EXPIRED if isinstance(reason, SessionExpired) else pb.SESSION_STATE_CLOSED
        self._registry.end(self._record(session), to_detail(reason))
        self._history.close(session.uid, state)
        if self._checkpoints is not None:
            self._checkpoints.delete(session.uid)

    async def last(self, session_id: str) -> SessionRecord | None:
        """The last session of this id, live or past; None: nothing is remembered of one.

        Raises:
            Unavailable: the database cannot be reached.
        """
        return await self._registry.newest(session_id) if is_session_id(session_id) else None

    async def alive(self) -> list[Session]:
        """The sessions that this server had when its process ended; their trackers are in no worker. Their clients may come
        back from now on, for as long as they might have after leaving a stream.

        Raises:
            Unavailable: the database cannot be reached, or another server may have them.
        """
        self._require_name()
        records = await self._registry.alive(self._server_id)
        return [_session(record) for record in records]

    async def clean(self, sessions: Callable[[], Iterable[Session]]) -> None:
        """Has checkpoints deleted that belong to none of these, as there are by then."""
        if self._checkpoints is not None:
            try:
                await self._checkpoints.keep_only(lambda: [session.uid for session in sessions()])
            except OSError as error:
                log.warning("old checkpoints could not be deleted: %s", error)

    async def newest(self, session: Session) -> pb.SessionSnapshot | pb.CreateSessionRequest | None:
        """What a session is had back from: its newest checkpoint, else its beginning; None: neither is there.

        Raises:
            Unavailable: it cannot be read now.
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


def _session(record: SessionRecord) -> Session:
    message = record.session
    opened = pb.Session()
    opened.CopyFrom(message)
    for field in _SHOWN:
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
        seated=False,
        asleep=True,
        departed=monotonic(),
    )

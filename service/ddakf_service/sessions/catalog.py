"""Catalog: live and ended sessions by id, and the caller's access to them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable, Iterator, Set

from ddakf_api.errors import PermissionDenied, ServiceError, SessionNotFound, Unauthenticated, Unavailable, from_detail, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ..auth.principal import current_principal
from ..store.tables.session_record import SessionRecord
from .page_token import Position, matches, page_size, page_token, position_after
from .session import Session

MAX_ENDED = 1024  # ended sessions whose reasons are in memory
LOAD_RETRY_INTERVAL = 3.0  # seconds between attempts to read the earlier sessions


class SessionCatalog:
    """Live sessions by id, and the reasons of ended ones. A session of another key is reported as not found.

    Args:
        newest_record: reads the newest session of an id from the registry; None: no such session. Raises ``Unavailable``.

    Attributes:
        loaded: the sessions from before the start of the process are included.
    """

    def __init__(self, newest_record: Callable[[str], Awaitable[SessionRecord | None]]):
        self._newest_record = newest_record
        self._live: dict[str, Session] = {}
        # Owner and serialised reason by id. An exception would keep its Python frames. A message would hold ten times its
        # size in an arena, below which the heap could not shrink.
        self._ended: OrderedDict[str, tuple[str | None, bytes]] = OrderedDict()
        self._shut_out: Set[str] = frozenset()
        self.loaded = False

    def __iter__(self) -> Iterator[Session]:
        """The live sessions at this moment; a copy."""
        return iter(list(self._live.values()))

    def __len__(self) -> int:
        return len(self._live)

    def __contains__(self, session_id: str) -> bool:
        return session_id in self._live

    def add(self, session: Session) -> None:
        self._live[session.id] = session
        self._ended.pop(session.id, None)

    def remove(self, session: Session, reason: ServiceError) -> None:
        """Removes a session; calls of its owner raise the reason from now on."""
        self._live.pop(session.id, None)
        self._ended[session.id] = session.owner, to_detail(reason).SerializeToString()
        while len(self._ended) > MAX_ENDED:
            self._ended.popitem(last=False)

    def shut_out(self, key_ids: Set[str]) -> None:
        """Sets the revoked keys. The guard may have admitted a call of theirs before."""
        self._shut_out = key_ids

    def live(self, session_ids: Iterable[str]) -> list[Session]:
        """The live sessions of these ids."""
        return [self._live[i] for i in session_ids if i in self._live]

    def readable(self, name: str) -> Session:
        """A live session that the caller's key may read.

        Raises:
            SessionNotFound: no live session that the key may read; if it has ended, the reason instead.
            Unauthenticated: the key was revoked.
            Unavailable: the earlier sessions are not loaded yet.
        """
        self.require_admitted()
        caller, session_id = current_principal.get(), name.removeprefix("sessions/")
        session = self._live.get(session_id)
        if session is not None and caller.may_read(session.owner):
            return session
        owner, reason = self._ended.get(session_id, (None, None))
        if session is None and reason is not None and caller.may_read(owner):
            raise from_detail(pb.ErrorDetail.FromString(reason))
        if session is None and not self.loaded:
            raise Unavailable(
                f"session {name[:80]!r} is not known before the database can be read; try again later",
                retry_after=LOAD_RETRY_INTERVAL,
            )
        raise not_found(name)

    def require_admitted(self) -> None:
        """Raises ``Unauthenticated`` where the caller's key was revoked."""
        if current_principal.get().id in self._shut_out:
            raise revoked()

    def require_live(self, session: Session) -> None:
        """Checks that a session has not ended; raises as :meth:`readable`."""
        if self.readable(session.name) is not session:  # another session has its name
            raise not_found(session.name)

    def changeable(self, name: str) -> Session:
        """A live session that the caller's key may use and change; raises as :meth:`readable`.

        Raises:
            PermissionDenied: the key may only read it.
        """
        session = self.readable(name)
        if not current_principal.get().may_change(session.owner):
            raise PermissionDenied(f"{session.name} belongs to another key")
        return session

    async def lookup(self, name: str) -> Session:
        """:meth:`readable`, extended by the reasons of sessions that ended before the start of the process."""
        try:
            return self.readable(name)
        except SessionNotFound:
            session_id = name.removeprefix("sessions/")
            in_memory = session_id in self._ended or session_id in self._live
            past = None if in_memory else await self._past(session_id)
            if past is not None and current_principal.get().may_read(past.owner):
                raise from_detail(past.reason) from None
            raise

    async def _past(self, session_id: str) -> SessionRecord | None:
        """The newest session of this id, if it has ended; None: no such session, or the database cannot be read."""
        try:
            record = await self._newest_record(session_id)
        except Unavailable:
            return None
        return record if record and record.reason else None

    async def newest(self, name: str) -> Session | SessionRecord:
        """The live session of a name, else the newest past one; raises as :meth:`readable`."""
        session_id = name.removeprefix("sessions/")
        if session_id in self._live:
            return self.readable(name)
        record = await self._newest_record(session_id)
        if record is None or not current_principal.get().may_read(record.owner):
            raise not_found(name)
        return record

    def page(self, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
        """One page of live sessions, oldest first.

        Raises:
            InvalidArgument: the token is not of a page with the same filter.
        """
        size, caller = page_size(request), current_principal.get()
        after = position_after(request)
        readable = (s for s in self if caller.may_read(s.owner) and matches(s, request))
        matching = sorted((s for s in readable if _position(s) > after), key=_position)
        page = matching[:size]
        more = page_token(request, _position(page[-1])) if len(matching) > size else ""
        return pb.ListSessionsResponse(sessions=[session.message() for session in page], next_page_token=more)


def not_found(name: str) -> SessionNotFound:
    return SessionNotFound(f"there is no session {name[:80]!r}")


def revoked() -> Unauthenticated:
    return Unauthenticated("the key was revoked or has expired")


def _position(session: Session) -> Position:
    return Position(int(session.created * 1e6), session.id)

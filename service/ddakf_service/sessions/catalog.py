"""Which sessions there are and were, and who may know of them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable, Iterator, Set

from ddakf_api.errors import PermissionDenied, ServiceError, SessionNotFound, Unauthenticated, Unavailable, from_detail, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ..auth.principal import current_principal
from ..store.session_record import SessionRecord
from .session import Session

REMEMBERED = 1024  # ended sessions whose reasons are known without the database
LOAD_PAUSE = 3.0  # seconds between attempts to read the earlier sessions
_PAGE_SIZE, _MAX_PAGE_SIZE = 50, 1000


class SessionCatalog:
    """The live sessions by id, and why those that have ended did. What belongs to another key is answered as what is not there.

    Args:
        registered: reads the last session of an id from the registry; None: none is registered. Raises ``Unavailable``.

    Attributes:
        complete: the sessions of before the start are among them.
    """

    def __init__(self, registered: Callable[[str], Awaitable[SessionRecord | None]]):
        self._registered = registered
        self._live: dict[str, Session] = {}
        # Owner and reason, serialised, by id: an exception would keep what it was raised through, and a message has ten times
        # its size in an arena on the heap, which could not shrink past it.
        self._ended: OrderedDict[str, tuple[str | None, bytes]] = OrderedDict()
        self._shut_out: Set[str] = frozenset()
        self.complete = False

    def __iter__(self) -> Iterator[Session]:
        """The live ones, as of now: they may come and go meanwhile."""
        return iter(list(self._live.values()))

    def __len__(self) -> int:
        return len(self._live)

    def __contains__(self, session_id: str) -> bool:
        return session_id in self._live

    def add(self, session: Session) -> None:
        self._live[session.id] = session
        self._ended.pop(session.id, None)

    def remove(self, session: Session, reason: ServiceError) -> None:
        """Whoever may ask for it is told the reason from now on."""
        self._live.pop(session.id, None)
        self._ended[session.id] = session.owner, to_detail(reason).SerializeToString()
        while len(self._ended) > REMEMBERED:
            self._ended.popitem(last=False)

    def shut_out(self, key_ids: Set[str]) -> None:
        """Keys that find nothing any more, though the guard may have let a call of theirs pass."""
        self._shut_out = key_ids

    def some(self, session_ids: Iterable[str]) -> list[Session]:
        """Those of these ids that are there."""
        return [self._live[i] for i in session_ids if i in self._live]

    def readable(self, name: str) -> Session:
        """A session that the key of this call may read.

        Raises:
            SessionNotFound, or why it ended: there is none that the key may know of. Unauthenticated: the key was revoked.
            Unavailable: the database has to be read first.
        """
        caller, session_id = current_principal.get(), name.removeprefix("sessions/")
        if caller.id in self._shut_out:
            raise revoked()
        session = self._live.get(session_id)
        if session is not None and caller.may_read(session.owner):
            return session
        owner, reason = self._ended.get(session_id, (None, None))
        if session is None and reason is not None and caller.may_read(owner):
            raise from_detail(pb.ErrorDetail.FromString(reason))
        if session is None and not self.complete:
            raise Unavailable(
                f"whether there is a session {name[:80]!r} is not known before the database can be read; try again later",
                retry_after=LOAD_PAUSE,
            )
        raise not_found(name)

    def mine(self, name: str) -> Session:
        """A session that the key of this call may use and change; raises as :meth:`readable`.

        Raises:
            PermissionDenied: the key may read it alone.
        """
        session = self.readable(name)
        if not current_principal.get().may_change(session.owner):
            raise PermissionDenied(f"{session.name} belongs to another key")
        return session

    async def known(self, name: str) -> Session:
        """As :meth:`readable`, but knows why a session ended even if that was before the start."""
        try:
            return self.readable(name)
        except SessionNotFound:
            session_id = name.removeprefix("sessions/")
            remembered = session_id in self._ended or session_id in self._live
            past = None if remembered else await self._past(session_id)
            if past is not None and current_principal.get().may_read(past.owner):
                raise from_detail(past.reason) from None
            raise

    async def _past(self, session_id: str) -> SessionRecord | None:
        """The last session of this id, if it has ended; None: nothing is remembered of one, or not now."""
        try:
            record = await self._registered(session_id)
        except Unavailable:
            return None
        return record if record and record.reason else None

    async def last(self, name: str) -> Session | SessionRecord:
        """The live session of a name, or else the last past one; raises as :meth:`readable`."""
        session_id = name.removeprefix("sessions/")
        if session_id in self._live:
            return self.readable(name)
        record = await self._registered(session_id)
        if record is None or not current_principal.get().may_read(record.owner):
            raise not_found(name)
        return record

    def page(self, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
        """Oldest first, one page; the token is the id of the last session of the page before."""
        size, caller = min(request.page_size or _PAGE_SIZE, _MAX_PAGE_SIZE), current_principal.get()
        wanted = sorted((s for s in self if caller.may_read(s.owner) and _matches(s, request)), key=_token)
        if request.page_token:
            wanted = [session for session in wanted if _token(session) > request.page_token]
        page = wanted[:size]
        more = _token(page[-1]) if len(wanted) > size else ""
        return pb.ListSessionsResponse(sessions=[session.message() for session in page], next_page_token=more)


def not_found(name: str) -> SessionNotFound:
    return SessionNotFound(f"there is no session {name[:80]!r}")


def revoked() -> Unauthenticated:
    return Unauthenticated("the key was revoked")


def _matches(session: Session, request: pb.ListSessionsRequest) -> bool:
    return (not request.states or session.state in request.states) and all(
        session.labels.get(key) == value for key, value in request.labels.items()
    )


def _token(session: Session) -> str:
    return f"{int(session.created * 1e6):020d}-{session.id}"

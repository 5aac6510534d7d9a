"""Past sessions: pages of the ended ones that the registry holds."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb

from ..auth.principal import Scope, current_principal
from ..store.tables.session_record import SessionRecord
from .page_token import Position, matches, page_size, page_token, position_after

STATES = frozenset({pb.SESSION_STATE_EXPIRED, pb.SESSION_STATE_CLOSED})
_BATCH = 200  # rows that are read at a time where labels are asked for

EndedRecords = Callable[[list[int], str | None, Position | None, int], Awaitable[list[SessionRecord]]]
"""States, owner (None: any), last row of the page before, most rows: ended sessions, newest first."""


def asks_for_past(request: pb.ListSessionsRequest) -> bool:
    """Whether a list is one of ended sessions.

    Raises:
        InvalidArgument: a state is none, or those of live and of ended sessions are mixed, which are listed in different orders.
    """
    states = set(request.states)
    if not states <= {*pb.SessionState.values()} - {pb.SESSION_STATE_UNSPECIFIED}:
        unknown = min(states - {*pb.SessionState.values()}, default=pb.SESSION_STATE_UNSPECIFIED)
        raise InvalidArgument(field="states", expected="states of sessions", got=f"the value {unknown}")
    if states & STATES and states - STATES:
        raise InvalidArgument(field="states", expected="states of live sessions or of ended ones", got="some of both")
    return bool(states & STATES)


async def past_page(ended: EndedRecords, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
    """One page of the ended sessions that the caller may read, newest first.

    Raises:
        InvalidArgument: the token is not of a page with the same filter.
        Unavailable: the database cannot be reached.
    """
    caller, size = current_principal.get(), page_size(request)
    owner = None if caller.allows(Scope.READ) else caller.id
    before = position_after(request) if request.page_token else None
    page: list[SessionRecord] = []
    count = _BATCH if request.labels else size + 1
    while True:
        batch = await ended(sorted(set(request.states)), owner, before, count)
        page += (record for record in batch if matches(record.session, request))
        if len(page) > size or len(batch) < count:
            break
        before = position_of(batch[-1])
    more = page_token(request, position_of(page[size - 1])) if len(page) > size else ""
    return pb.ListSessionsResponse(sessions=[record.session for record in page[:size]], next_page_token=more)


def position_of(record: SessionRecord) -> Position:
    return Position(int(record.create_time * 1e6), record.id)

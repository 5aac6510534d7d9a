"""Listing: pages of the live sessions of all gateways."""

from __future__ import annotations

from ddakf_api.v1 import tracking_pb2 as pb

from ...auth.principal import Scope, current_principal
from ...store.tables.leases import Leases
from ..catalog import SessionCatalog
from ..page_token import Position, matches, page_size, page_token, position_after

_BATCH = 1000  # rows that are read at a time
_LAST = Position(1 << 63, "")
_ROUNDING = 2e-6  # seconds; more than the rounding of a creation time


async def shared_page(leases: Leases, catalog: SessionCatalog, request: pb.ListSessionsRequest) -> pb.ListSessionsResponse:
    """One page of the live sessions that the caller may read, oldest first. Those of this gateway are as of this moment.

    Raises:
        InvalidArgument: the token is not of a page with the same filter. Unavailable: the database cannot be reached.
    """
    caller, size, after = current_principal.get(), page_size(request), position_after(request)
    owner = None if caller.allows(Scope.READ) else caller.id
    found = {s.id: s.message() for s in catalog if caller.may_read(s.owner)}
    begin = after.created / 1e6 - _ROUNDING
    while True:
        records = await leases.live_page(owner, begin, _BATCH)
        # Of this gateway's sessions the rows lag behind, and some are not written yet.
        found.update({record.id: record.session for record in records if record.id not in catalog})
        complete = len(records) < _BATCH
        until = _LAST if complete else _position(records[-1].session)
        listed = (session for session in found.values() if after < _position(session) <= until)
        matching = sorted((session for session in listed if matches(session, request)), key=_position)
        if complete or len(matching) > size:
            break
        begin = records[-1].create_time
    page = matching[:size]
    more = page_token(request, _position(page[-1])) if len(matching) > size else ""
    return pb.ListSessionsResponse(sessions=page, next_page_token=more)


def _position(session: pb.Session) -> Position:
    return Position(session.create_time.ToNanoseconds() // 1000, session.name.removeprefix("sessions/"))

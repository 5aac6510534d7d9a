"""Page tokens: the last row of a page and the filter that it was listed with."""

from __future__ import annotations

import hashlib
import re
from typing import NamedTuple

from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb

_FORM = re.compile(r"([0-9]{1,20})-([0-9a-f]{16})-([a-z0-9-]{1,128})")
_MAX_SHOWN = 80  # characters of an invalid token in a message


_PAGE_SIZE, _MAX_PAGE_SIZE = 50, 1000


class Position(NamedTuple):
    """Place of a row in a list: its creation in microseconds since 1970, and its id."""

    created: int
    id: str


def page_size(request: pb.ListSessionsRequest | pb.ListMeshesRequest) -> int:
    """The most rows of a page."""
    return min(request.page_size or _PAGE_SIZE, _MAX_PAGE_SIZE)


def page_token(request: pb.ListSessionsRequest | pb.ListMeshesRequest, last: Position) -> str:
    """The token of the page after a row."""
    return f"{last.created}-{_filter(request)}-{last.id}"


def position_after(request: pb.ListSessionsRequest | pb.ListMeshesRequest) -> Position:
    """The last row of the page before.

    Raises:
        InvalidArgument: no token of a server, or one of a list with another filter.
    """
    if not request.page_token:
        return Position(-1, "")
    found = _FORM.fullmatch(request.page_token)
    if found is None:
        got = repr(request.page_token[:_MAX_SHOWN])
        raise InvalidArgument(field="page_token", expected="next_page_token of the page before", got=got)
    if found[2] != _filter(request):
        expected = "a token of the same states and labels"
        raise InvalidArgument(field="page_token", expected=expected, got="one of another filter")
    return Position(int(found[1]), found[3])


def _filter(request: pb.ListSessionsRequest | pb.ListMeshesRequest) -> str:
    """A digest of what is listed: for sessions the states and labels, in any order."""
    values: tuple = (type(request).__name__,)
    if isinstance(request, pb.ListSessionsRequest):
        values = sorted(set(request.states)), sorted(request.labels.items())
    return hashlib.sha256(repr(values).encode()).hexdigest()[:16]


def matches(session, request: pb.ListSessionsRequest) -> bool:
    """Whether a session, or its message, has one of the states and all labels of a request."""
    return (not request.states or session.state in request.states) and all(
        session.labels.get(key) == value for key, value in request.labels.items()
    )

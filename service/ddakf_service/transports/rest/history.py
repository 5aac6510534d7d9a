"""REST history: the query of a session's history as a message of the contract."""

from __future__ import annotations

from datetime import UTC, datetime

from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb

_YEAR_10000 = 253_402_300_800  # seconds since 1970, UTC


def history_request(
    session_id: str, start: datetime | None, end: datetime | None, resolution: float, max_samples: int
) -> pb.GetSessionHistoryRequest:
    """The request as a message of the contract.

    Raises:
        InvalidArgument: a time before 1970 or after the year 9999 in UTC.
    """
    request = pb.GetSessionHistoryRequest(name=f"sessions/{session_id}", resolution=resolution, max_samples=max_samples)
    for field, moment in (("start_time", start), ("end_time", end)):
        if moment is None:
            continue
        seconds = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        if not 0 <= seconds < _YEAR_10000:
            raise InvalidArgument(field=field, expected="a time from 1970 to 9999", got=moment.isoformat())
        getattr(request, field).FromMicroseconds(round(seconds * 1e6))
    return request

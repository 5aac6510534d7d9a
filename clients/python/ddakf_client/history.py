"""Session history: counts, reliability, latency and state changes over time."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.calls import session_name
from ddakf_client.results import value_name


class StateChange(NamedTuple):
    """A change of the session to this state."""

    time: datetime
    state: str


@dataclass(frozen=True, eq=False)
class History:
    """Statistics of n intervals in temporal order, without empty intervals. Times are of the server's clock.

    Attributes:
        name: "sessions/{session_id}".
        resolution: length of an interval, seconds.
        start: (n,) start of each interval, seconds since 1970.
        applied, dropped, late, rejected: (n,) frames.
        reliability, least_reliability: (n,) mean and minimum over the applied frames, in [0, 1].
        paper_score, coverage: (n,) means.
        latency, greatest_latency: (n,) seconds from arrival to answer, mean and maximum.
        states: state changes; the first may precede the first interval.
    """

    name: str
    resolution: float
    start: np.ndarray
    applied: np.ndarray
    dropped: np.ndarray
    late: np.ndarray
    rejected: np.ndarray
    reliability: np.ndarray
    least_reliability: np.ndarray
    paper_score: np.ndarray
    coverage: np.ndarray
    latency: np.ndarray
    greatest_latency: np.ndarray
    states: tuple[StateChange, ...]


def history_request(
    session_id: str,
    *,
    start: datetime | None = None,
    end: datetime | None = None,
    resolution: float = 0.0,
    max_samples: int = 0,
) -> pb.GetSessionHistoryRequest:
    """The request of ``Client.history``.

    Raises:
        InvalidArgument: an argument of another type or out of range.
    """
    request = pb.GetSessionHistoryRequest(name=session_name(session_id))
    for field, value in (("resolution", resolution), ("max_samples", max_samples)):
        try:
            setattr(request, field, value)
        except (TypeError, ValueError, OverflowError):
            integer = field == "max_samples"
            expected = "a whole number from 0 to 4294967295" if integer else "a number of seconds"
            raise InvalidArgument(field=field, expected=expected, got=repr(value)[:80]) from None
    for field, value in (("start", start), ("end", end)):
        if value is None:
            continue
        if not isinstance(value, datetime) or value.tzinfo is None:
            raise InvalidArgument(field=field, expected="a datetime with a time zone", got=repr(value)[:80])
        getattr(request, f"{field}_time").FromDatetime(value.astimezone(UTC))
    return request


def history_from(message: pb.SessionHistory) -> History:
    """Converts a message to arrays."""
    samples = message.samples

    def column(name: str) -> np.ndarray:
        return np.array([getattr(sample, name) for sample in samples])

    return History(
        name=message.name,
        resolution=message.resolution,
        start=np.array([sample.start_time.ToNanoseconds() / 1e9 for sample in samples]),
        **{name: column(f"frames_{name}").astype(int) for name in ("applied", "dropped", "late", "rejected")},
        **{name: column(name) for name in ("reliability", "least_reliability", "paper_score", "coverage")},
        **{name: column(name) for name in ("latency", "greatest_latency")},
        states=tuple(StateChange(c.time.ToDatetime(UTC), value_name(pb.SessionState, c.state)) for c in message.state_changes),
    )

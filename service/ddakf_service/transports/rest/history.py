"""REST history: a session's history as JSON, and its request."""

from __future__ import annotations

from datetime import UTC, datetime

from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from pydantic import BaseModel, Field

from .responses import StateName, state_name

_YEAR_10000 = 253_402_300_800  # seconds since 1970, UTC


class HistorySample(BaseModel):
    """Frames from the start of this sample to the start of the next."""

    start_time: datetime
    frames_applied: int
    frames_dropped: int
    frames_late: int
    frames_rejected: int
    reliability: float = Field(description="mean of the applied frames, in [0, 1]; high means low error")
    least_reliability: float
    paper_score: float = Field(description="mean")
    coverage: float = Field(description="mean share of the vertices that were measured")
    latency: float = Field(description="mean of the seconds from arrival to answer")
    greatest_latency: float


class StateChange(BaseModel):
    """The state of the session from this time on."""

    time: datetime
    state: StateName


class HistoryOut(BaseModel):
    """Samples in order of time, none for spans without frames. The first change of state may precede the first sample."""

    name: str
    resolution: float = Field(description="seconds per sample")
    samples: list[HistorySample]
    state_changes: list[StateChange]

    @classmethod
    def of(cls, history: pb.SessionHistory) -> HistoryOut:
        return cls(
            name=history.name,
            resolution=history.resolution,
            samples=[_sample(sample) for sample in history.samples],
            state_changes=[
                StateChange(
                    time=change.time.ToDatetime(UTC),
                    state=state_name(change.state),
                )
                for change in history.state_changes
            ],
        )


def history_request(
    session_id: str, start: datetime | None, end: datetime | None, resolution: float, max_samples: int
) -> pb.GetSessionHistoryRequest:
    """The request as a message of the contract.

    Raises:
        InvalidArgument: a time before 1970 or after the year 9999 in UTC.
    """
    request = pb.GetSessionHistoryRequest(name=f"sessions/{session_id}", resolution=resolution, max_samples=max_samples)
    for field, name, moment in (("start_time", "from", start), ("end_time", "to", end)):
        if moment is None:
            continue
        seconds = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        if not 0 <= seconds < _YEAR_10000:
            raise InvalidArgument(field=name, expected="a time from 1970 to 9999", got=moment.isoformat())
        getattr(request, field).FromMicroseconds(round(seconds * 1e6))
    return request


def _sample(sample: pb.HistorySample) -> HistorySample:
    values = {name: getattr(sample, name) for name in HistorySample.model_fields if name != "start_time"}
    return HistorySample(start_time=sample.start_time.ToDatetime(UTC), **values)

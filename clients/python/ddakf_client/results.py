"""Answers of the server as Python objects. V garment vertices; metres and seconds."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from ddakf_api.arrays import unpack
from ddakf_api.codec import CODECS, DEPTH_CODECS
from ddakf_api.errors import ServiceError, from_detail
from ddakf_api.v1 import tracking_pb2 as pb

_UPPER = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])  # indices of xx xy xz yy yz zz in the rows of a symmetric matrix
_MAX_ITEMS = 1 << 28  # the message size bounds arrays of the server


class InputWarning(NamedTuple):
    """A sign that the input is wrong, although it could be tracked.

    Attributes:
        code: "sensor_origin_missing", "length_unit", ...; the names of ``WarningCode`` in the contract, in lower case.
        field: of the frame or the session that is probably wrong.
        message: one sentence, with the numbers that gave it away.
    """

    code: str
    field: str
    message: str


class WarningCount(NamedTuple):
    """A warning of a session: that of the last frame that had it, and the number of these frames."""

    warning: InputWarning
    frames: int


class Usage(NamedTuple):
    """Processor time of a frame on the server, and what its budget left out.

    Attributes:
        processor_seconds: of the worker, decoding included.
        budget_seconds: that were planned with; 0: no budget.
        widening: factor by which sigma was widened for the work that was left out; 1: nothing was.
        working_vertices: that were tracked; the garment's others are carried along.
        lighter: a lighter tracker, on a coarser mesh, has gone on for the session, as the server is crowded.
    """

    processor_seconds: float
    budget_seconds: float
    widening: float
    working_vertices: int = 0
    lighter: bool = False


@dataclass(frozen=True, eq=False)
class Result:
    """The garment after one frame.

    Attributes:
        sequence: number of the frame, from 1 on in a session; frame i (from 0) of a stream has that of its first one plus i.
        timestamp: of the frame, seconds of the caller's clock.
        state: "initializing", "tracking", "recovering" or "lost".
        vertices: (V, 3) float32 metres.
        sigma: (V,) float32, sqrt(trace(covariance) / 3), metres.
        vertex_reliability: (V,) float32 in [0, 1].
        observed: (V,) bool, the vertex has a measurement in this frame.
        velocities: (V, 3) float32 metres per second, or None if not requested.
        covariance: (V, 3, 3) float32 square metres, or None if not requested.
        reliability: of the frame, in [0, 1]; high means low error.
        paper_score: s_k of the paper.
        coverage: fraction of observed vertices.
        dropped: frames replaced by a newer one: of the session on the server, and of this stream before sending.
        rejected: frames of the session that the server refused.
        applied: frames of the session that the server tracked, including this one.
        late: frames of the session that the server did not track, because their deadline had passed.
        timings: seconds per stage of the tracker and of the server.
        display_time: time of the arrays, seconds of the caller's clock: the timestamp, or the display time of the frame.
        latency: seconds from the submission of the frame to the arrival of the result.
        warnings: signs of wrong input, at most one of each code.
        usage: processor time of the frame, its budget, and what that left out.
    """

    sequence: int
    timestamp: float
    state: str
    vertices: np.ndarray
    sigma: np.ndarray
    vertex_reliability: np.ndarray
    observed: np.ndarray
    velocities: np.ndarray | None
    covariance: np.ndarray | None
    reliability: float
    paper_score: float
    coverage: float
    dropped: int
    rejected: int
    applied: int
    timings: dict[str, float]
    display_time: float
    latency: float
    late: int
    warnings: tuple[InputWarning, ...]
    usage: Usage


@dataclass(frozen=True)
class FrameError:
    """A refused frame; the session is unchanged.

    Attributes:
        sequence: number of the frame.
        timestamp: of the frame, seconds of the caller's clock, or None.
        error: the exception that ``on_error="raise"`` raises.
    """

    sequence: int
    timestamp: float | None
    error: ServiceError


@dataclass(frozen=True)
class Notice:
    """A message of the server between results.

    Attributes:
        kind: "draining", "slow_down", "reconnect", "resumed" or "waiting".
        message: one sentence.
        value: draining: remaining seconds; slow_down: frames per second that can be tracked; resumed: tracked frames lost by
            the server; waiting: seconds so far.
        target: reconnect: address of the server, may be empty.
    """

    kind: str
    message: str
    value: float
    target: str


class Limits(NamedTuple):
    """Limits of a session; 0 means the default of the server in a request, and no limit in an answer.

    Points per frame, frames per second, seconds without a frame, seconds since creation, unanswered frames in lossless
    mode, seconds until the client has to reconnect after the end of a stream.
    """

    max_points: int = 0
    max_frame_rate: float = 0.0
    idle_timeout: float = 0.0
    max_lifetime: float = 0.0
    max_frames_in_flight: int = 0
    departure_timeout: float = 0.0


@dataclass(frozen=True)
class SessionInfo:
    """State and statistics of a session; reliability, paper_score and coverage are of the last frame.

    Attributes:
        name: "sessions/{session_id}".
        state: as in :class:`Result`, or "idle", "expired", "closed".
        config: the complete configuration in force; None in a list of sessions.
        frame_rate: frames per second over the last few seconds.
        last_sequence, last_timestamp: of the last applied frame; 0: none.
        etag: changes with every update; see ``Session.update``.
        expire_time: time of its expiry without further activity.
        checkpoint_time: time of the newest checkpoint; None: none.
        last_frame_time: time of the last applied frame, the server's clock; None: none.
        last_latency: seconds from arrival at the server to the result, of the last frame.
        recoveries, lost: restarts from a checkpoint, and tracked frames lost by them.
        memory: estimated memory in its worker, bytes.
        warnings: signs of wrong input since its creation, each code once.
    """

    name: str
    session_id: str
    state: str
    labels: dict[str, str]
    create_time: datetime
    config: dict[str, Any] | None
    fabric: str
    limits: Limits
    n_vertices: int
    n_faces: int
    n_body_vertices: int
    applied: int
    dropped: int
    rejected: int
    frame_rate: float
    reliability: float
    paper_score: float
    coverage: float
    last_sequence: int
    last_timestamp: float
    etag: str
    expire_time: datetime | None
    late: int
    recoveries: int
    lost: int
    memory: int
    checkpoint_time: datetime | None
    last_frame_time: datetime | None
    last_latency: float
    warnings: tuple[WarningCount, ...]


@dataclass(frozen=True)
class MeshInfo:
    """An uploaded mesh; ``size``: bytes that count for the quota of the key."""

    name: str
    n_vertices: int
    n_faces: int
    size: int
    create_time: datetime


@dataclass(frozen=True)
class ServerInfo:
    """Properties and limits of a server; codecs by their names in this client."""

    api_version: str
    server_version: str
    codecs: tuple[str, ...]
    fabrics: tuple[str, ...]
    max_message_bytes: int
    max_vertices: int
    max_body_vertices: int
    max_limits: Limits
    draining: bool
    build: str
    depth_codecs: tuple[str, ...]


def result_from(message: pb.Result, *, dropped_before_sending: int, latency: float) -> Result:
    """Converts a message. Missing arrays are empty; velocities and covariance are None."""
    optional = {name: _array(message, name, n) for name, n in (("velocities", 3), ("covariance", 6))}
    covariance = optional["covariance"]
    return Result(
        sequence=message.sequence_number,
        timestamp=message.capture_time,
        state=value_name(pb.TrackerState, message.state),
        vertices=_array(message, "vertices", 3, np.empty((0, 3), np.float32)),
        sigma=_array(message, "sigma", None, np.empty(0, np.float32)),
        vertex_reliability=_array(message, "vertex_reliability", None, np.empty(0, np.float32)),
        observed=_array(message, "observed", None, np.empty(0, bool)),
        velocities=optional["velocities"],
        covariance=None if covariance is None else covariance[:, _UPPER].reshape(-1, 3, 3),
        reliability=message.reliability,
        paper_score=message.paper_score,
        coverage=message.coverage,
        dropped=message.frames_dropped + dropped_before_sending,
        rejected=message.frames_rejected,
        applied=message.frames_applied,
        timings=dict(message.timings),
        display_time=message.display_time or message.capture_time,
        latency=latency,
        late=message.frames_late,
        warnings=tuple(warning_from(warning) for warning in message.warnings),
        usage=_usage_from(message.usage),
    )


def _usage_from(message: pb.Usage) -> Usage:
    processor, budget = message.processor_seconds, message.budget_seconds
    return Usage(processor, budget, message.widening or 1.0, message.working_vertices, message.lighter)


def warning_from(message: pb.Warning) -> InputWarning:
    return InputWarning(value_name(pb.WarningCode, message.code), message.field, message.message)


def frame_error_from(message: pb.FrameError) -> FrameError:
    error = from_detail(message.error)
    error.sequence = message.sequence_number
    return FrameError(message.sequence_number, message.capture_time, error)


def notice_from(message: pb.Notice) -> Notice:
    return Notice(value_name(pb.NoticeKind, message.kind), message.message, message.value, message.target)


def session_info_from(message: pb.Session) -> SessionInfo:
    statistics = message.statistics
    return SessionInfo(
        name=message.name,
        session_id=message.name.removeprefix("sessions/"),
        state=value_name(pb.SessionState, message.state),
        labels=dict(message.labels),
        create_time=message.create_time.ToDatetime(UTC),
        config=json.loads(message.config_json) if message.config_json else None,
        fabric=message.fabric,
        limits=_limits_from(message.limits),
        n_vertices=message.garment_vertex_count,
        n_faces=message.garment_face_count,
        n_body_vertices=message.body_vertex_count,
        applied=statistics.frames_applied,
        dropped=statistics.frames_dropped,
        rejected=statistics.frames_rejected,
        frame_rate=statistics.frame_rate,
        reliability=statistics.reliability,
        paper_score=statistics.paper_score,
        coverage=statistics.coverage,
        last_sequence=statistics.last_sequence_number,
        last_timestamp=statistics.last_capture_time,
        etag=message.etag,
        expire_time=_time(message, "expire_time"),
        late=statistics.frames_late,
        recoveries=statistics.recoveries,
        lost=statistics.frames_lost,
        memory=statistics.memory_bytes,
        checkpoint_time=_time(message, "checkpoint_time"),
        last_frame_time=_time(statistics, "last_frame_time"),
        last_latency=statistics.last_latency,
        warnings=tuple(WarningCount(warning_from(count.warning), count.frames) for count in statistics.warnings),
    )


def mesh_info_from(message: pb.StoredMesh) -> MeshInfo:
    created = message.create_time.ToDatetime(UTC)
    return MeshInfo(message.name, message.vertex_count, message.face_count, message.bytes, created)


def vertex_map_from(message: pb.Session) -> np.ndarray | None:
    """(V,) uint32: vertex i of the garment is vertex map[i] of the sent mesh; None if the mesh was not cleaned."""
    return _array(message, "vertex_map", None)


def server_info_from(message: pb.ServerInfo) -> ServerInfo:
    return ServerInfo(
        api_version=message.api_version,
        server_version=message.server_version,
        codecs=tuple(name for name, codec in CODECS.items() if codec in message.point_codecs),
        fabrics=tuple(message.fabrics),
        max_message_bytes=message.max_message_bytes,
        max_vertices=message.max_vertices,
        max_body_vertices=message.max_body_vertices,
        max_limits=_limits_from(message.max_limits),
        draining=message.draining,
        build=message.build,
        depth_codecs=tuple(name for name, codec in DEPTH_CODECS.items() if codec in message.depth_compressions),
    )


def _limits_from(message: pb.SessionLimits) -> Limits:
    return Limits(*(getattr(message, name) for name in Limits._fields))


def _time(message, name: str) -> datetime | None:
    return getattr(message, name).ToDatetime(UTC) if message.HasField(name) else None


def _array(message, name: str, components: int | None, missing: np.ndarray | None = None) -> np.ndarray | None:
    if not message.HasField(name):
        return missing
    return unpack(getattr(message, name), components, field=name, max_items=_MAX_ITEMS)


@functools.lru_cache(256)
def value_name(enum, value: int) -> str:
    """Name of an enum value in the style of the library: lower case, without the prefix of the enum."""
    if value not in enum.values():
        return f"unknown_{value}"
    prefix = enum.Name(0).removesuffix("UNSPECIFIED")
    return enum.Name(value).removeprefix(prefix).lower()

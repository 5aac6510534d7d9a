"""REST responses: the contract's messages as JSON, with the same names and enumerations in lower case."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any, Literal

from ddakf_api.arrays import unpack
from ddakf_api.v1 import tracking_pb2 as pb
from pydantic import BaseModel, Field

StateName = Literal["initializing", "tracking", "recovering", "lost", "idle", "expired", "closed"]

_STATE_PREFIX = "SESSION_STATE_"


def state_name(state: int) -> str:
    """The name of a SessionState value."""
    return pb.SessionState.Name(state).removeprefix(_STATE_PREFIX).lower()


class Limits(BaseModel):
    """Effective limits; a rate or a lifetime of 0 is not limited."""

    max_points: int
    max_frame_rate: float
    idle_timeout: float
    max_lifetime: float
    max_frames_in_flight: int
    departure_timeout: float

    @classmethod
    def of(cls, limits: pb.SessionLimits) -> Limits:
        return cls(**{name: getattr(limits, name) for name in cls.model_fields})


class Statistics(BaseModel):
    """Counters, and numbers of the last frame."""

    frames_applied: int
    frames_dropped: int = Field(description="displaced by a newer frame in realtime flow, or above the frame rate")
    frames_late: int = Field(description="not tracked because their deadline passed")
    frames_rejected: int = Field(description="answered with an error")
    frames_lost: int = Field(description="applied frames that were lost when the session was restored from a checkpoint")
    recoveries: int = Field(description="number of such restores")
    frame_rate: float = Field(description="frames applied per second over the last few seconds")
    reliability: float = Field(description="in [0, 1]; high means low error")
    paper_score: float
    coverage: float = Field(description="share of the vertices that were measured")
    last_sequence_number: int
    last_capture_time: float = Field(description="seconds of the client's clock")
    last_frame_time: datetime | None = None
    last_latency: float = Field(description="seconds from arrival at the server to the result")
    memory_bytes: int = Field(description="estimated memory of the session in its worker")

    @classmethod
    def of(cls, statistics: pb.SessionStatistics) -> Statistics:
        numbers = {name: getattr(statistics, name) for name in cls.model_fields if name != "last_frame_time"}
        return cls(**numbers, last_frame_time=_time(statistics, "last_frame_time"))


class PackedOut(BaseModel):
    encoding: str
    data: str = Field(description="base64 of packed little-endian rows")


class MeshOut(BaseModel):
    vertices: PackedOut
    faces: PackedOut


class SessionOut(BaseModel):
    """A session."""

    name: str
    labels: dict[str, str]
    state: StateName
    create_time: datetime
    expire_time: datetime | None = Field(None, description="time of expiry without further frames")
    checkpoint_time: datetime | None = Field(None, description="time of the newest checkpoint")
    config: dict[str, Any] = Field(description="the full effective configuration")
    fabric: str
    limits: Limits
    statistics: Statistics
    etag: str
    garment_vertex_count: int
    garment_face_count: int
    body_vertex_count: int
    vertex_map: list[int] | None = Field(
        None,
        description="vertex i of the tracked garment is vertex vertex_map[i] of the mesh that was sent; with clean",
    )
    garment: MeshOut | None = Field(None, description="in the full view")
    body: MeshOut | None = Field(None, description="in the full view")

    @classmethod
    def of(cls, session: pb.Session) -> SessionOut:
        has_map = session.HasField("vertex_map")
        return cls(
            name=session.name,
            labels=dict(session.labels),
            state=state_name(session.state),
            create_time=session.create_time.ToDatetime(UTC),
            expire_time=_time(session, "expire_time"),
            checkpoint_time=_time(session, "checkpoint_time"),
            config=json.loads(session.config_json),
            fabric=session.fabric,
            limits=Limits.of(session.limits),
            statistics=Statistics.of(session.statistics),
            etag=session.etag,
            garment_vertex_count=session.garment_vertex_count,
            garment_face_count=session.garment_face_count,
            body_vertex_count=session.body_vertex_count,
            vertex_map=_indices(session.vertex_map) if has_map else None,
            garment=_mesh_out(session.garment) if session.HasField("garment") else None,
            body=_mesh_out(session.body) if session.HasField("body") else None,
        )


class SessionList(BaseModel):
    """One page, oldest session first."""

    sessions: list[SessionOut]
    next_page_token: str = Field(description="empty on the last page")

    @classmethod
    def of(cls, page: pb.ListSessionsResponse) -> SessionList:
        return cls(sessions=[SessionOut.of(session) for session in page.sessions], next_page_token=page.next_page_token)


class Readiness(BaseModel):
    """Readiness for sessions, and problems of other parts."""

    status: Literal["ready", "degraded"]
    problems: list[str] = Field(description="one sentence for each failing part; tracking continues")


class Info(BaseModel):
    """Versions and limits of the server."""

    api_version: str
    server_version: str
    build: str
    point_codecs: list[str]
    depth_compressions: list[str]
    result_encodings: list[str]
    fabrics: list[str]
    max_message_bytes: int
    max_vertices: int
    max_limits: Limits
    draining: bool

    @classmethod
    def of(cls, info: pb.ServerInfo) -> Info:
        return cls(
            api_version=info.api_version,
            server_version=info.server_version,
            build=info.build,
            point_codecs=_names(pb.PointCodec, info.point_codecs),
            depth_compressions=_names(pb.DepthCompression, info.depth_compressions),
            result_encodings=_names(pb.ArrayEncoding, info.result_encodings),
            fabrics=list(info.fabrics),
            max_message_bytes=info.max_message_bytes,
            max_vertices=info.max_vertices,
            max_limits=Limits.of(info.max_limits),
            draining=info.draining,
        )


def _names(enum, values: Iterable[int]) -> list[str]:
    """Values of an enumeration without its own name, in lower case."""
    prefix = enum.Name(0).removesuffix("UNSPECIFIED")
    return [enum.Name(value).removeprefix(prefix).lower() for value in values]


def _time(message, field: str) -> datetime | None:
    return getattr(message, field).ToDatetime(UTC) if message.HasField(field) else None


def _packed_out(array: pb.PackedArray) -> PackedOut:
    encoding = pb.ArrayEncoding.Name(array.encoding).removeprefix("ARRAY_ENCODING_").lower()
    return PackedOut(encoding=encoding, data=base64.b64encode(array.data).decode())


def _mesh_out(mesh: pb.Mesh) -> MeshOut:
    return MeshOut(vertices=_packed_out(mesh.vertices), faces=_packed_out(mesh.faces))


def _indices(array: pb.PackedArray) -> list[int]:
    return unpack(array, field="vertex_map", max_items=len(array.data)).tolist()

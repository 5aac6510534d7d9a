"""REST requests: JSON bodies and queries as messages of the contract, with the same names."""

from __future__ import annotations

import base64
import json
from typing import Annotated, Any, Literal, get_args

import numpy as np
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from pydantic import BaseModel, ConfigDict, Field

from ddakf.physics.fabric import PRESETS

from .responses import StateName, state_name

KEY_VALUES = {"items": {"type": "string", "pattern": "="}}
STATES = {"items": {"type": "string", "enum": list(get_args(StateName))}}
_BASE64 = {"contentEncoding": "base64", "pattern": "^([A-Za-z0-9+/]{4})*([A-Za-z0-9+/]{2}==|[A-Za-z0-9+/]{3}=)?$"}
_FABRICS = {"enum": ["", *PRESETS]}


class _FailFast:
    """Makes a list stop at its first invalid row; otherwise each one yields an error of a kilobyte. (pydantic's FailFast has
    no hash, which unions need.)"""

    def __get_pydantic_core_schema__(self, source, handler):
        return {**handler(source), "fail_fast": True}


Rows = Annotated[list[tuple[float, float, float]], _FailFast()]
IndexRows = Annotated[list[tuple[int, int, int]], _FailFast()]

_FLOATS = {"float32": pb.ARRAY_ENCODING_FLOAT32, "float64": pb.ARRAY_ENCODING_FLOAT64}
_INTEGERS = {"uint32": pb.ARRAY_ENCODING_UINT32}

EXAMPLE_ID = "shirt-1"
TRIANGLE = {"vertices": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], "faces": [[0, 1, 2]]}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class PackedFloats(_Strict):
    """Numbers as base64 of packed little-endian rows of three."""

    encoding: Literal["float32", "float64"]
    data: str = Field(description="base64", json_schema_extra=_BASE64)


class PackedIndices(_Strict):
    """Indices as base64 of packed little-endian rows of three."""

    encoding: Literal["uint32"]
    data: str = Field(description="base64", json_schema_extra=_BASE64)


class MeshIn(_Strict):
    """A triangle mesh; metres."""

    vertices: Rows | PackedFloats = Field(description="(V, 3) positions, metres")
    faces: IndexRows | PackedIndices = Field(description="(F, 3) vertex indices, counter-clockwise seen from outside")


class LimitsIn(_Strict):
    """Limits of a session. An omitted limit, or one beyond the server's, becomes the server's."""

    max_points: int = Field(0, ge=0, le=2**32 - 1, description="points per frame")
    max_frame_rate: float = Field(0.0, ge=0, description="frames per second")
    idle_timeout: float = Field(0.0, ge=0, description="seconds without a frame after which the session expires")
    max_lifetime: float = Field(0.0, ge=0, description="seconds after its creation at which the session expires")
    max_frames_in_flight: int = Field(0, ge=0, le=2**32 - 1, description="queued frames in lossless flow")
    departure_timeout: float = Field(0.0, ge=0, description="seconds that a session waits for a client that left its stream")

    def to_message(self) -> pb.SessionLimits:
        return pb.SessionLimits(**{name: getattr(self, name) for name in LimitsIn.model_fields})


class CreateSession(_Strict):
    """A garment to track."""

    garment: MeshIn = Field(description="the garment in its rest shape")
    body: MeshIn | None = Field(None, description="the body in its pose at the start")
    config: dict[str, Any] | None = Field(None, description="the tracker's configuration; an omitted field keeps its default")
    fabric: str = Field("", max_length=64, description="a fabric preset by name", json_schema_extra=_FABRICS)
    labels: dict[str, str] = Field(default_factory=dict, description="free key-value pairs")
    limits: LimitsIn = Field(default_factory=LimitsIn)
    session_id: str = Field("", description="4-63 of [a-z0-9-] beginning with a letter; empty: the server chooses")
    request_id: str = Field("", max_length=256, description="makes a repeated call harmless")
    clean: bool = Field(False, description="repair the garment instead of rejecting it, and return the vertex map")
    api_version: str = Field("1.0", description="version of the contract that the client speaks")

    def to_message(self) -> pb.CreateSessionRequest:
        session = pb.Session(
            labels=self.labels,
            config_json=_config_json(self.config),
            fabric=self.fabric,
            limits=self.limits.to_message(),
            garment=_mesh_message(self.garment, "garment"),
        )
        if self.body is not None:
            session.body.CopyFrom(_mesh_message(self.body, "body"))
        return pb.CreateSessionRequest(
            api_version=self.api_version,
            session=session,
            session_id=self.session_id,
            request_id=self.request_id,
            clean=self.clean,
        )


class UpdateSession(_Strict):
    """Changes of a session. An omitted field stays unchanged, unless the mask names it."""

    labels: dict[str, str] = Field(default_factory=dict, description="all of them")
    config: dict[str, Any] | None = Field(None, description="the tracker's configuration")
    fabric: str = Field("", max_length=64, description="a fabric preset by name", json_schema_extra=_FABRICS)
    limits: LimitsIn = Field(default_factory=LimitsIn, description="all of them")
    etag: str = Field("", max_length=64, description="etag of the session to change; a different one is rejected")

    def to_message(self, name: str, update_mask: str) -> pb.UpdateSessionRequest:
        names = [path.strip() for path in update_mask.split(",")] if update_mask else sorted(self.model_fields_set - {"etag"})
        session = pb.Session(
            name=name,
            etag=self.etag,
            labels=self.labels,
            config_json=_config_json(self.config),
            fabric=self.fabric,
            limits=self.limits.to_message(),
        )
        request = pb.UpdateSessionRequest(session=session)
        request.update_mask.paths.extend("config_json" if path == "config" else path for path in names)
        return request if names else pb.UpdateSessionRequest(session=pb.Session(name=name, etag=self.etag))


class ResetSession(_Strict):
    """Initial state of a reset tracker."""

    vertices: Rows | PackedFloats | None = Field(None, description="(V, 3) metres; null: the rest shape")
    velocities: Rows | PackedFloats | None = Field(None, description="(V, 3) metres per second; null: none")

    def to_message(self, name: str) -> pb.ResetSessionRequest:
        request = pb.ResetSessionRequest(name=name)
        for field in ("vertices", "velocities"):
            if (value := getattr(self, field)) is not None:
                getattr(request, field).CopyFrom(_packed(value, field, "float64", _FLOATS))
        return request


class RestoreSession(LimitsIn):
    """Query of a restore; the snapshot is the request body."""

    model_config = ConfigDict(strict=False)  # a query has only text

    session_id: str = Field("", description="4-63 of [a-z0-9-] beginning with a letter; empty: the server chooses")
    request_id: str = Field("", max_length=256, description="makes a repeated call harmless")
    label: list[str] = Field(default_factory=list, description="labels of the session, key=value", json_schema_extra=KEY_VALUES)
    api_version: str = Field("1.0", description="version of the contract that the client speaks")

    def to_message(self, data: bytes) -> pb.RestoreSessionRequest:
        return pb.RestoreSessionRequest(
            api_version=self.api_version,
            session=pb.Session(labels=dict(key_value(text) for text in self.label), limits=LimitsIn.to_message(self)),
            session_id=self.session_id,
            request_id=self.request_id,
            data=data,
        )


def states_from(names: list[str]) -> list[int]:
    """SessionState values by their lower-case names."""
    known = {state_name(value): value for value in pb.SessionState.values() if value}
    for name in names:
        if name not in known:
            raise InvalidArgument(field="state", expected=" or ".join(known), got=repr(name[:80]))
    return [known[name] for name in names]


def key_value(text: str) -> tuple[str, str]:
    """A label of a query, as key and value."""
    key, separator, value = text.partition("=")
    if not separator:
        raise InvalidArgument(field="label", expected="key=value", got=repr(text[:80]))
    return key, value


def _config_json(config: dict[str, Any] | None) -> str:
    return "" if config is None else json.dumps(config)


def _mesh_message(mesh: MeshIn, field: str) -> pb.Mesh:
    return pb.Mesh(
        vertices=_packed(mesh.vertices, f"{field}.vertices", "float64", _FLOATS),
        faces=_packed(mesh.faces, f"{field}.faces", "uint32", _INTEGERS),
    )


def _packed(value, field: str, list_encoding: str, encodings: dict[str, int]) -> pb.PackedArray:
    if isinstance(value, list):
        try:
            data = np.array(value, np.dtype(list_encoding).newbyteorder("<")).tobytes()
        except OverflowError:
            raise InvalidArgument(field=field, expected=f"numbers within {list_encoding}", got="one outside") from None
        return pb.PackedArray(encoding=encodings[list_encoding], data=data)
    try:
        return pb.PackedArray(encoding=encodings[value.encoding], data=base64.b64decode(value.data, validate=True))
    except ValueError as error:  # not base64, or not ASCII
        raise InvalidArgument(field=f"{field}.data", expected="base64", got=str(error)) from None

"""REST requests: JSON bodies and queries as messages of the contract, with the names of the resource's address."""

from __future__ import annotations

from ddakf_api import API_VERSION
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf.descriptor import EnumDescriptor
from pydantic import BaseModel, ConfigDict, Field

from ..dialect import earlier, reading
from ..truncation import printable

KEY_VALUES = {"items": {"type": "string", "pattern": "="}}
EXAMPLE_ID = "shirt-1"
TRIANGLE = {"vertices": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], "faces": [[0, 1, 2]]}

_CHANGEABLE_FIELDS = ("config_json", "fabric", "labels", "limits")
_MESH_FIELDS = ("garment", "body", "garment_mesh", "body_mesh")


def create_request(body: bytes) -> pb.CreateSessionRequest:
    """The body of a creation. Without an API version it has that of the address."""
    request = reading.read(body, pb.CreateSessionRequest)
    request.api_version = request.api_version or API_VERSION
    return request


def update_request(body: bytes, name: str, update_mask: str) -> pb.UpdateSessionRequest:
    """The body of an update. Without a mask it changes the fields that the body has, also those with default values."""
    values = reading.parsed(body, pb.UpdateSessionRequest)
    request = reading.message_from(values, pb.UpdateSessionRequest)
    _address(request.session, name, "session.name")
    paths = earlier.mask_paths(update_mask) or list(request.update_mask.paths)
    del request.update_mask.paths[:]
    request.update_mask.paths.extend(paths or _given(values, request.session))
    return request if request.update_mask.paths else pb.UpdateSessionRequest(session={"name": name, "etag": request.session.etag})


def reset_request(body: bytes, name: str) -> pb.ResetSessionRequest:
    """The body of a reset."""
    request = reading.read(body, pb.ResetSessionRequest)
    _address(request, name, "name")
    return request


def is_match(if_match: str, etag: str) -> bool:
    """Whether the header If-Match has the etag of a session, in quotes or not, or ``*``."""
    tags = [tag.strip() for tag in if_match.split(",")]
    return "*" in tags or etag in tags or f'"{etag}"' in tags


class RestoreSession(BaseModel):
    """Query of a restore; the snapshot is the request body. An omitted limit, or one beyond the server's, becomes the
    server's."""

    model_config = ConfigDict(extra="forbid")

    session_id: str = Field("", description="4-63 of [a-z0-9-] beginning with a letter; empty: the server chooses")
    request_id: str = Field("", max_length=256, description="makes a repeated call harmless")
    labels: list[str] = Field(default_factory=list, description="key=value", json_schema_extra=KEY_VALUES)
    label: list[str] = Field(
        default_factory=list, description="earlier name of labels", json_schema_extra={**KEY_VALUES, "deprecated": True}
    )
    api_version: str = Field(API_VERSION, description="version of the contract that the client speaks")
    max_points: int = Field(0, ge=0, le=2**32 - 1, description="points per frame")
    max_frame_rate: float = Field(0.0, ge=0, description="frames per second")
    idle_timeout: float = Field(0.0, ge=0, description="seconds without frames or calls on the tracker that end the session")
    max_lifetime: float = Field(0.0, ge=0, description="seconds after its creation at which the session expires")
    max_frames_in_flight: int = Field(0, ge=0, le=2**32 - 1, description="queued frames in lossless flow")
    departure_timeout: float = Field(0.0, ge=0, description="seconds that a session waits for a client that left its stream")

    def to_message(self, data: bytes) -> pb.RestoreSessionRequest:
        limits = pb.SessionLimits(**{field.name: getattr(self, field.name) for field in pb.SessionLimits.DESCRIPTOR.fields})
        return pb.RestoreSessionRequest(
            api_version=self.api_version,
            session=pb.Session(labels=labels_from([*self.labels, *self.label]), limits=limits),
            session_id=self.session_id,
            request_id=self.request_id,
            data=data,
        )


def enum_numbers(names: list[str], enum: EnumDescriptor, field: str) -> list[int]:
    """Values of an enumeration by their names in a query."""
    numbers = [earlier.enum_number(enum, name) for name in names]
    for name, number in zip(names, numbers, strict=True):
        if number is None:
            expected = " or ".join(value.name for value in enum.values[1:])
            raise InvalidArgument(field=field, expected=expected, got=repr(name[:80]))
    return numbers


def labels_from(texts: list[str]) -> dict[str, str]:
    """The labels of a query, each ``key=value``."""
    labels: dict[str, str] = {}
    for text in texts:
        key, separator, value = text.partition("=")
        if not separator:
            raise InvalidArgument(field="labels", expected="key=value", got=repr(text[:80]))
        if labels.setdefault(key, value) != value:
            raise InvalidArgument(field="labels", expected="one value of each key", got=f"two of {key[:80]!r}")
    return labels


def _given(values: dict, session: pb.Session) -> list[str]:
    """Names of the fields to change that the session of an update has. The others may be those of an answer: in that of a list
    config_json is empty.

    Args:
        session: the same, as a message.

    Raises:
        InvalidArgument: a mesh, which would stay as it is.
    """
    for field, _ in session.ListFields():
        if field.name in _MESH_FIELDS:
            raise InvalidArgument(field=field.name, expected="no mesh, as a session keeps those of its creation", got="a mesh")
    given = earlier.nested(values, pb.UpdateSessionRequest.DESCRIPTOR).get("session") or {}
    fields = reading.fields_of(pb.Session.DESCRIPTOR)
    given = earlier.renamed(given, pb.Session.DESCRIPTOR)
    names = {fields[name].name for name, value in given.items() if value is not None}.intersection(_CHANGEABLE_FIELDS)
    return sorted(names if session.config_json else names - {"config_json"})


def _address(message: pb.Session | pb.ResetSessionRequest, name: str, field: str) -> None:
    """Sets the name of the resource, which the message may repeat."""
    if message.name not in ("", name):
        raise InvalidArgument(field=field, expected=f"{name}, as in the address, or nothing", got=printable(message.name))
    message.name = name

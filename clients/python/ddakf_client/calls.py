"""Requests, checks of answers and errors, shared by the synchronous and the asynchronous client."""

from __future__ import annotations

import asyncio
import json
import math
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from typing import TypeVar

import grpc
import numpy as np
from ddakf_api import API_VERSION
from ddakf_api.arrays import checked_array, pack, pack_mesh
from ddakf_api.errors import (
    ERROR_METADATA_KEY,
    Cancelled,
    CodecError,
    DeadlineExceeded,
    Draining,
    InvalidArgument,
    InvalidConfig,
    InvalidMesh,
    ServiceError,
    Unavailable,
    from_rpc_error,
)
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.version import require_compatible
from google.protobuf.descriptor import FieldDescriptor

from ddakf_client.results import Limits, ServerInfo, server_info_from

T = TypeVar("T")

TIMEOUT = 10.0
"""Default timeout in seconds of a call, and of the answer to a frame."""

LONGEST_TIMEOUT = 1e9
"""Largest timeout in seconds; with a much larger one, a call of gRPC fails at once."""

CLOSED = "the client is closed"
_SCHEMES = ("dns", "unix", "ipv4", "ipv6", "xds")  # of gRPC's addresses


def metadata_for(api_key: str | None) -> tuple[tuple[str, str], ...]:
    """The metadata of every call: the key, without the white space around it that a file has.

    Raises:
        InvalidArgument: the key cannot be sent in a header; the error does not show it.
    """
    if api_key is None:
        return ()
    expected = "printable characters of ASCII, which a header can have"
    if not isinstance(api_key, str):
        raise InvalidArgument(field="api_key", expected=expected, got=type(api_key).__name__)
    key = api_key.strip()
    for character in key:
        if not (character.isascii() and character.isprintable()):
            raise InvalidArgument(field="api_key", expected=expected, got=f"{character!a} among {len(key)}")
    return (("authorization", f"Bearer {key}"),) if key else ()


def targets_of(target: str | Sequence[str]) -> tuple[str, ...]:
    """The addresses of ``connect``: one or several, with commas between them or as a list.

    Raises:
        InvalidArgument: there is none, one has no port, or one is no text.
    """
    if isinstance(target, str):
        target = [part.strip() for part in target.split(",")]
    if not isinstance(target, Sequence) or not all(isinstance(each, str) for each in target):
        raise InvalidArgument(field="target", expected="HOST:PORT of gRPC, or a list of such", got=repr(target)[:80])
    targets = tuple(target)
    if not targets:
        raise InvalidArgument(field="target", expected="HOST:PORT of gRPC", got="an empty list")
    for each in targets:
        require_target(each)
    return targets


def after(target: str, targets: Sequence[str]) -> str:
    """The address to try after one that does not answer: the next one, after the last the first."""
    return targets[(targets.index(target) + 1) % len(targets)] if target in targets else targets[0]


def may_call_elsewhere(error: grpc.RpcError, failed: ServiceError, method: str) -> bool:
    """Whether a failed call may be made at another address: no server has answered it, or it is about to stop."""
    answered = any(key == ERROR_METADATA_KEY for key, _ in error.trailing_metadata() or ())
    silent = type(failed) is Unavailable or (type(failed) is DeadlineExceeded and method == "GetServerInfo")
    return type(failed) is Draining or (silent and not answered)


def require_target(target: str) -> None:
    """Raises :class:`InvalidArgument` unless the address is gRPC's and ends with a port.

    gRPC takes a port that is too large for another one, and a scheme of others for the name of a host.
    """
    scheme, separator, _ = target.partition("://")
    address, _, port = target.rpartition("/")[2].rpartition(":")
    is_port = port.isascii() and port.isdecimal() and 0 < int(port) < 1 << 16
    is_foreign = separator and scheme not in _SCHEMES
    if is_foreign or not (target.startswith("unix:") or (address and is_port)):
        raise InvalidArgument(field="target", expected="HOST:PORT of gRPC", got=repr(target[:80]))


def failure(error: grpc.RpcError, target: str, timeout: float) -> ServiceError:
    """The exception of a failed call. Errors that the server did not send name the server and the timeout."""
    failed = from_rpc_error(error)
    if type(failed) is Unavailable:
        return Unavailable(f"{target} does not answer: {failed.message}", retry_after=failed.retry_after)
    if type(failed) is DeadlineExceeded:
        return DeadlineExceeded(f"{target} gave no answer within {timeout:g} s")
    if type(failed) is Cancelled and "Channel closed!" in failed.message:  # words of gRPC when this side closes
        return Cancelled(CLOSED)
    return failed


def opened_in_thread(open_stream: Callable[[], T]) -> T:
    """Opens a stream in another thread, where no handler of a signal runs.

    gRPC creates the call, and then a thread that completes it. KeyboardInterrupt between the two, in the main thread, would leave
    a call that nothing completes, for which the end of the channel waits.
    """
    opened: Future[T] = Future()

    def run() -> None:
        try:
            opened.set_result(open_stream())
        except BaseException as error:
            opened.set_exception(error)

    threading.Thread(target=run, name="ddakf-opener", daemon=True).start()
    return opened.result()


@contextmanager
def closing_is_an_error() -> Iterator[None]:
    """Raises :class:`Cancelled` where grpc.aio raises CancelledError because the client was closed, not the task cancelled."""
    try:
        yield
    except asyncio.CancelledError:
        if asyncio.current_task().cancelling():
            raise
        raise Cancelled(CLOSED) from None


def checked_server(message: pb.ServerInfo) -> ServerInfo:
    """Converts the description of the server.

    Raises:
        VersionMismatch: the server has another major version.
    """
    require_compatible(message.api_version, peer="server")
    return server_info_from(message)


def message_limit(of_client: int, server: ServerInfo) -> float:
    """Largest request in bytes: the smaller limit of both sides. One that is not above 0 is none."""
    return min((limit for limit in (of_client, server.max_message_bytes) if limit > 0), default=math.inf)


def require_codec(codec: str, server: ServerInfo) -> None:
    """Raises :class:`CodecError` unless the server supports the codec."""
    if codec not in server.codecs:
        expected = f"a codec of the server, {' or '.join(server.codecs)}"
        raise CodecError(field="codec", expected=expected, got=repr(codec))


def plain(value: object) -> object:
    """A number of NumPy as one of Python: arithmetic with a float32 would round times to minutes."""
    return value.item() if isinstance(value, np.generic) else value


def require_timeout(timeout: object) -> None:
    """Raises :class:`InvalidArgument` unless it is a number of seconds above 0, at most :data:`LONGEST_TIMEOUT`."""
    if not _is_number(timeout) or not 0 < timeout <= LONGEST_TIMEOUT:
        expected = f"seconds above 0, at most {LONGEST_TIMEOUT:g}"
        raise InvalidArgument(field="timeout", expected=expected, got=repr(timeout)[:80])


def require_step(step: object) -> None:
    """Raises :class:`InvalidArgument` unless it is a finite number of metres above 0."""
    if not _is_number(step) or not 0 < step < math.inf:
        raise InvalidArgument(field="step", expected="metres above 0", got=repr(step)[:80])


def require_handler(on_notice: object) -> None:
    """Raises :class:`InvalidArgument` unless it can be called with a notice, which may come late."""
    if not callable(on_notice):
        raise InvalidArgument(field="on_notice", expected="a function of a Notice", got=repr(on_notice)[:80])


def require_every_nth(every_nth: object) -> None:
    """Raises :class:`InvalidArgument` unless it is an integer of at least 1."""
    if not isinstance(every_nth, (int, np.integer)) or isinstance(every_nth, bool) or not 1 <= every_nth < 2**32:
        raise InvalidArgument(field="every_nth", expected="a whole number from 1 on", got=repr(every_nth)[:80])


def create_request(
    garment: object,
    faces: np.ndarray | None,
    *,
    body: object = None,
    config: object = None,
    fabric: str = "",
    clean: bool = False,
    labels: Mapping[str, str] | None = None,
    limits: Limits | None = None,
    session_id: str = "",
) -> pb.CreateSessionRequest:
    """The request of ``create_session``, which describes the arguments."""
    _require_type("clean", clean, (bool, np.bool_), "True or False")
    session = pb.Session(labels=_labels(labels), config_json=_config_json(config), fabric=_text("fabric", fabric))
    if isinstance(garment, str):
        session.garment_mesh = _text("garment", garment)
    else:
        session.garment.CopyFrom(_mesh(garment, faces, "garment"))
    if isinstance(body, str):
        session.body_mesh = _text("body", body)
    elif body is not None:
        pair = body if isinstance(body, tuple) and len(body) == 2 else (body, None)
        session.body.CopyFrom(_mesh(*pair, "body"))
    if limits is not None:
        session.limits.CopyFrom(_limits(limits))
    return pb.CreateSessionRequest(
        api_version=API_VERSION,
        session=session,
        session_id=_text("session_id", session_id),
        request_id=str(uuid.uuid4()),
        clean=bool(clean),
    )


def mesh_request(mesh: object, faces: np.ndarray | None) -> pb.CreateMeshRequest:
    """The request of ``upload_mesh``, which describes the arguments."""
    return pb.CreateMeshRequest(api_version=API_VERSION, mesh=_mesh(mesh, faces, "mesh"))


def delete_mesh_request(name: str) -> pb.DeleteMeshRequest:
    return pb.DeleteMeshRequest(name=_text("name", name))


def restore_request(
    data: bytes,
    *,
    labels: Mapping[str, str] | None = None,
    limits: Limits | None = None,
    session_id: str = "",
) -> pb.RestoreSessionRequest:
    _require_type("snapshot", data, (bytes, bytearray, memoryview), "the bytes of Session.snapshot")
    request = pb.RestoreSessionRequest(
        api_version=API_VERSION,
        session_id=_text("session_id", session_id),
        request_id=str(uuid.uuid4()),
        data=bytes(data),
    )
    request.session.labels.update(_labels(labels))
    if limits is not None:
        request.session.limits.CopyFrom(_limits(limits))
    return request


def update_request(
    name: str,
    *,
    labels: Mapping[str, str] | None = None,
    config: object = None,
    fabric: str | None = None,
    limits: Limits | None = None,
    etag: str = "",
) -> pb.UpdateSessionRequest:
    request = pb.UpdateSessionRequest(session=pb.Session(name=name, etag=_text("etag", etag)))
    given = {"labels": labels, "config_json": config, "fabric": fabric, "limits": limits}
    request.update_mask.paths.extend(path for path, value in given.items() if value is not None)
    request.session.labels.update(_labels(labels))
    request.session.config_json = _config_json(config)
    request.session.fabric = "" if fabric is None else _text("fabric", fabric)
    if limits is not None:
        request.session.limits.CopyFrom(_limits(limits))
    return request


def reset_request(
    name: str, vertices: np.ndarray | None = None, *, velocities: np.ndarray | None = None
) -> pb.ResetSessionRequest:
    request = pb.ResetSessionRequest(name=name)
    for field, array in (("vertices", vertices), ("velocities", velocities)):
        if array is None:
            continue
        array = checked_array(field, array, expected="numbers of shape (V, 3)")
        getattr(request, field).CopyFrom(pack(array, pb.ARRAY_ENCODING_FLOAT64))
    return request


def list_request(
    *, state: str | None = None, labels: Mapping[str, str] | None = None, page_token: str = ""
) -> pb.ListSessionsRequest:
    request = pb.ListSessionsRequest(labels=_labels(labels), page_token=page_token)
    if state is not None:
        names = {name.removeprefix("SESSION_STATE_").lower(): value for name, value in pb.SessionState.items() if value}
        if not isinstance(state, str) or state not in names:
            raise InvalidArgument(field="state", expected=" or ".join(names), got=repr(state))
        request.states.append(names[state])
    return request


def session_name(session_id: str) -> str:
    """The name "sessions/{id}" of an id, or the name itself."""
    _text("session_id", session_id)
    return session_id if session_id.startswith("sessions/") else f"sessions/{session_id}"


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def _require_type(field: str, value: object, types: type | tuple[type, ...], expected: str) -> None:
    if not isinstance(value, types):
        raise InvalidArgument(field=field, expected=expected, got=_described(value))


def _text(field: str, value: object) -> str:
    _require_type(field, value, str, "text")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise InvalidArgument(field=field, expected="text that UTF-8 can encode", got=ascii(value)[:80]) from None
    return value


def _labels(labels: object) -> dict[str, str]:
    if labels is None:
        return {}
    _require_type("labels", labels, Mapping, "a dict of text to text")
    for key, value in labels.items():
        if not isinstance(key, str):
            raise InvalidArgument(field="labels", expected="text as keys", got=_described(key))
        _text("labels", key)
        _text(f"labels[{key!r}]", value)
    return dict(labels)


def _limits(limits: object) -> pb.SessionLimits:
    _require_type("limits", limits, Limits, "a ddakf_client.Limits")
    message = pb.SessionLimits()
    for name, value in limits._asdict().items():
        if value is None:
            continue
        try:
            setattr(message, name, value)
        except (TypeError, ValueError, OverflowError):
            integer = message.DESCRIPTOR.fields_by_name[name].cpp_type != FieldDescriptor.CPPTYPE_DOUBLE
            expected = "a whole number from 0 to 4294967295" if integer else "a number"
            raise InvalidArgument(field=f"limits.{name}", expected=expected, got=_described(value)) from None
    return message


def _described(value: object) -> str:
    """Describes a value in an error: its type, and the value itself if it is short."""
    if isinstance(value, (float, str)) or (isinstance(value, int) and value.bit_length() <= 128):
        return f"{type(value).__name__} {repr(value)[:40]}"
    return type(value).__name__


def _mesh(mesh: object, faces: np.ndarray | None, field: str) -> pb.Mesh:
    if faces is None:
        if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
            expected = "vertices and faces, or an object with both"
            raise InvalidMesh(field=field, expected=expected, got=f"{type(mesh).__name__} alone")
        mesh, faces = mesh.vertices, mesh.faces
    return pack_mesh(mesh, faces, field=field)


def _config_json(config: object) -> str:
    if config is None:
        return ""
    values = config.to_dict() if hasattr(config, "to_dict") else config
    if not isinstance(values, Mapping):
        raise InvalidConfig(field="config", expected="a dict or a ddakf.Config", got=type(config).__name__)
    try:
        return json.dumps(values, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InvalidConfig(field="config", expected="values that JSON can represent", got=str(error)) from None

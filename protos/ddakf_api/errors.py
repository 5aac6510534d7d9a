"""Errors of the service: one class per name with its gRPC and HTTP codes. The wire carries the name, clients raise the class.

An error is sent as a gRPC status whose trailing metadata ``ddakf-error-bin`` holds an ``ErrorDetail``, as the ``error``
of a ``FrameError`` inside a stream, and as JSON with the same fields over HTTP.
"""

from __future__ import annotations

import re
from typing import ClassVar

import grpc
from grpc import StatusCode

from ddakf_api.v1 import tracking_pb2 as pb

ERROR_METADATA_KEY = "ddakf-error-bin"
_LONGEST_TEXT = 4000  # characters of each text of an error
_GRPC_TOO_LARGE = re.compile(r"larger than max \((\d+) vs\. (\d+)\)")  # in the text of gRPC on either side

ERRORS: dict[str, type[ServiceError]] = {}
"""Error classes by wire name, in the order of this file. The first class of a gRPC code is the default for that code."""


class ServiceError(Exception):
    """Base of all errors that the service or its client raises deliberately.

    Attributes:
        field: the invalid field, e.g. ``point_cloud.data``; may be empty.
        expected, got: description of valid values, and of the received one; may be empty.
        retry_after: seconds after which a retry makes sense; 0: unknown.
        sequence: sequence number of the frame, or None.
        status, http_status: gRPC and HTTP code of the class.
        retryable: the same request may succeed later.
    """

    status: ClassVar[StatusCode] = StatusCode.INTERNAL
    http_status: ClassVar[int] = 500
    retryable: ClassVar[bool] = False

    def __init_subclass__(cls, *, status: StatusCode, http: int, retryable: bool = False) -> None:
        cls.status, cls.http_status, cls.retryable = status, http, retryable
        ERRORS[cls.__name__] = cls

    def __init__(
        self, message: str = "", *, field: str = "", expected: str = "", got: str = "", retry_after: float = 0.0
    ):
        self.message = message or f"{field}: expected {expected}, got {got}"
        self.field, self.expected, self.got, self.retry_after = field, expected, got, retry_after
        self.sequence: int | None = None
        super().__init__(self.message)

    def __reduce__(self):
        return _from_state, (type(self), self.message, self.__dict__)


class InvalidArgument(ServiceError, ValueError, status=StatusCode.INVALID_ARGUMENT, http=422):
    """An invalid input; no state was changed."""


class InvalidMesh(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """A mesh that cannot serve as a garment or body."""


class InvalidFrame(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """A frame with invalid points, time, origin or body."""


class CodecError(InvalidFrame, status=StatusCode.INVALID_ARGUMENT, http=422):
    """Points that cannot be encoded, or data that cannot be decoded within the limits."""


class InvalidConfig(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """A configuration value outside its range, or an unknown field."""


class InvalidFile(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """A file of another format or content than its name or use requires."""


class InvalidSnapshot(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """Data that is no snapshot of a tracker, or one of an unknown version."""


class Unauthenticated(ServiceError, status=StatusCode.UNAUTHENTICATED, http=401):
    """No API key, or an unknown one."""


class PermissionDenied(ServiceError, status=StatusCode.PERMISSION_DENIED, http=403):
    """The scopes of the API key do not allow the call."""


class SessionNotFound(ServiceError, status=StatusCode.NOT_FOUND, http=404):
    """The session does not exist, or no longer exists."""


class SessionExpired(SessionNotFound, status=StatusCode.NOT_FOUND, http=410):
    """The session exceeded its idle timeout or its lifetime."""


class SessionExists(ServiceError, status=StatusCode.ALREADY_EXISTS, http=409):
    """The requested session id is in use."""


class FailedPrecondition(ServiceError, status=StatusCode.FAILED_PRECONDITION, http=409):
    """The state does not allow the call: messages in the wrong order, or an update of a changed resource."""


class SessionBusy(ServiceError, status=StatusCode.FAILED_PRECONDITION, http=409):
    """The session already has a stream; ``takeover`` ends that stream."""


class VersionMismatch(ServiceError, status=StatusCode.FAILED_PRECONDITION, http=400):
    """Client and server have incompatible API versions."""


class StreamTakenOver(ServiceError, status=StatusCode.ABORTED, http=409):
    """Another client took over the session of this stream."""


class ResourceExhausted(ServiceError, status=StatusCode.RESOURCE_EXHAUSTED, http=429, retryable=True):
    """The server, the API key or the session has reached a limit."""


class MessageTooLarge(ResourceExhausted, status=StatusCode.RESOURCE_EXHAUSTED, http=413):
    """A request with more bytes than the server accepts."""


class FrameTooCostly(ServiceError, status=StatusCode.RESOURCE_EXHAUSTED, http=429):
    """A frame that exceeded its limit of processor time, or the end of a session that has sent too many of them."""


class Unavailable(ServiceError, status=StatusCode.UNAVAILABLE, http=503, retryable=True):
    """The server does not answer, or is not ready."""


class WorkerLost(ServiceError, status=StatusCode.UNAVAILABLE, http=503, retryable=True):
    """The session's worker process died. Repeat a refused frame or call; after the end of a stream create the session again."""


class Draining(ServiceError, status=StatusCode.UNAVAILABLE, http=503, retryable=True):
    """The server is shutting down and accepts no new work."""


class DeadlineExceeded(ServiceError, status=StatusCode.DEADLINE_EXCEEDED, http=504):
    """No answer within the timeout of the caller."""


class Cancelled(ServiceError, status=StatusCode.CANCELLED, http=499):
    """One side ended the call before it was complete."""


class Unimplemented(ServiceError, status=StatusCode.UNIMPLEMENTED, http=501):
    """The contract has the feature, this server does not."""


class Internal(ServiceError, status=StatusCode.INTERNAL, http=500):
    """A defect of the server; its log has the details."""


class NotFound(ServiceError, status=StatusCode.NOT_FOUND, http=404):
    """No such mesh of the key, or no such address on the HTTP port."""


class MethodNotAllowed(ServiceError, status=StatusCode.INVALID_ARGUMENT, http=405):
    """The address has other methods; ``Allow`` names them. HTTP only."""


def class_of(error: BaseException) -> type[ServiceError]:
    """The wire class of an exception: the class with its name or that of its nearest base, else :class:`Internal`.

    The lookup is by name, so that errors of the library such as ``ddakf.errors.InvalidMesh`` need no second table.
    """
    return next((ERRORS[base.__name__] for base in type(error).__mro__ if base.__name__ in ERRORS), Internal)


def to_detail(error: BaseException) -> pb.ErrorDetail:
    """The message of an exception. An unexpected exception gives only its type, because its text may contain private data.

    Texts of any origin can be sent: long ones are cut, lone surrogates are replaced.
    """
    cls = class_of(error)
    if cls is Internal and not isinstance(error, Internal):
        return pb.ErrorDetail(name=cls.__name__, message=f"internal error ({type(error).__name__})")
    return pb.ErrorDetail(
        name=cls.__name__,
        field=_sendable(getattr(error, "field", "")),
        expected=_sendable(getattr(error, "expected", "")),
        got=_sendable(getattr(error, "got", "")),
        message=_sendable(str(error)),
        retry_after=getattr(error, "retry_after", 0.0),
    )


def to_metadata(detail: pb.ErrorDetail) -> tuple[tuple[str, bytes], ...]:
    """Trailing metadata of a gRPC call that fails with this error."""
    return ((ERROR_METADATA_KEY, detail.SerializeToString()),)


def from_detail(detail: pb.ErrorDetail) -> ServiceError:
    """The exception that a client raises. An unknown name, of a later version, gives :class:`ServiceError` itself."""
    return ERRORS.get(detail.name, ServiceError)(
        detail.message or detail.name,
        field=detail.field,
        expected=detail.expected,
        got=detail.got,
        retry_after=detail.retry_after,
    )


def from_rpc_error(error: grpc.RpcError) -> ServiceError:
    """The exception of a failed gRPC call: from its detail, or from its status code if gRPC itself failed the call."""
    for key, value in error.trailing_metadata() or ():
        if key == ERROR_METADATA_KEY:
            return from_detail(pb.ErrorDetail.FromString(value))
    cls = next((cls for cls in ERRORS.values() if cls.status is error.code()), Internal)
    text = error.details() or cls.__doc__
    if cls is ResourceExhausted and (sizes := _GRPC_TOO_LARGE.search(text)):
        size, most = sizes.groups()
        return MessageTooLarge(text, field="message", expected=f"at most {most} bytes", got=f"{size} bytes")
    return cls(text)


def first_line(error: BaseException) -> str:
    """First line of another library's error message, at most 120 characters."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _sendable(text: str) -> str:
    short = text if len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."
    return short.encode(errors="replace").decode()


def _from_state(cls: type[ServiceError], message: str, state: dict) -> ServiceError:
    error = cls(message)
    error.__dict__.update(state)
    return error

"""The errors of the service: one class per name, with its codes. The wire carries the name, clients raise the class.

An error travels as a gRPC status whose trailing metadata ``ddakf-error-bin`` holds an ``ErrorDetail``, as the ``error``
of a ``FrameError`` inside a stream, and as JSON with the same fields over HTTP.
"""

from __future__ import annotations

from typing import ClassVar

import grpc
from grpc import StatusCode

from ddakf_api.v1 import tracking_pb2 as pb

ERROR_METADATA_KEY = "ddakf-error-bin"

ERRORS: dict[str, type[ServiceError]] = {}
"""Every error by its wire name, in the order of this file. The first one of a gRPC code stands for that code."""


class ServiceError(Exception):
    """Base of every error that the service or its client raises on purpose.

    Attributes:
        field: what it is about, e.g. ``point_cloud.data``; may be empty.
        expected, got: what would have been accepted, what came; may be empty.
        retry_after: seconds after which trying again makes sense; 0 when not said.
        sequence: sequence number of the frame it is about, or None.
        status, http_status: gRPC and HTTP code of the class.
        retryable: the same request may succeed later without a change.
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
    """An input that cannot be used; nothing has been changed."""


class InvalidMesh(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """A mesh that cannot serve as a garment or body."""


class InvalidFrame(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """A frame that cannot be tracked: points, time, origin or body."""


class CodecError(InvalidFrame, status=StatusCode.INVALID_ARGUMENT, http=422):
    """Points that cannot be encoded, or a payload that cannot be decoded within its limits."""


class InvalidConfig(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """A configuration value outside its range, or an unknown field."""


class InvalidFile(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """A file that is not what its name or its use says."""


class InvalidSnapshot(InvalidArgument, status=StatusCode.INVALID_ARGUMENT, http=422):
    """Bytes that are no snapshot of a tracker, or of an unknown version."""


class Unauthenticated(ServiceError, status=StatusCode.UNAUTHENTICATED, http=401):
    """No key, or one that is not known."""


class PermissionDenied(ServiceError, status=StatusCode.PERMISSION_DENIED, http=403):
    """The key's scopes do not include this."""


class SessionNotFound(ServiceError, status=StatusCode.NOT_FOUND, http=404):
    """No session of this name, or not any more."""


class SessionExpired(SessionNotFound, status=StatusCode.NOT_FOUND, http=410):
    """The session passed its idle timeout or its lifetime."""


class SessionExists(ServiceError, status=StatusCode.ALREADY_EXISTS, http=409):
    """The chosen session id is taken."""


class FailedPrecondition(ServiceError, status=StatusCode.FAILED_PRECONDITION, http=409):
    """Not in this state: messages in the wrong order, an update of something in use."""


class SessionBusy(ServiceError, status=StatusCode.FAILED_PRECONDITION, http=409):
    """The session already has a stream; ``takeover`` would end that one."""


class VersionMismatch(ServiceError, status=StatusCode.FAILED_PRECONDITION, http=400):
    """Client and server speak versions of the contract that do not fit together."""


class StreamTakenOver(ServiceError, status=StatusCode.ABORTED, http=409):
    """Another client took this stream's session over."""


class ResourceExhausted(ServiceError, status=StatusCode.RESOURCE_EXHAUSTED, http=429, retryable=True):
    """The server, the key or the session is at a limit."""


class MessageTooLarge(ResourceExhausted, status=StatusCode.RESOURCE_EXHAUSTED, http=413):
    """A request with more bytes than the server takes."""


class Unavailable(ServiceError, status=StatusCode.UNAVAILABLE, http=503, retryable=True):
    """No server answers, or it is not ready."""


class WorkerLost(ServiceError, status=StatusCode.UNAVAILABLE, http=503, retryable=True):
    """The process that tracked the session died; the session goes on from its checkpoint or has to be created again."""


class Draining(ServiceError, status=StatusCode.UNAVAILABLE, http=503, retryable=True):
    """The server is about to stop and takes nothing new."""


class DeadlineExceeded(ServiceError, status=StatusCode.DEADLINE_EXCEEDED, http=504):
    """No answer in the time that the caller gave."""


class Cancelled(ServiceError, status=StatusCode.CANCELLED, http=499):
    """The call was ended by one of its sides before it was complete."""


class Unimplemented(ServiceError, status=StatusCode.UNIMPLEMENTED, http=501):
    """The contract has it, this server does not."""


class Internal(ServiceError, status=StatusCode.INTERNAL, http=500):
    """A defect of the server; its log says more."""


def class_of(error: BaseException) -> type[ServiceError]:
    """The class that stands for an exception on the wire: of its name or its nearest base's, else :class:`Internal`.

    By name, so that ``ddakf.errors.InvalidMesh`` and the like need no table of their own.
    """
    return next((ERRORS[base.__name__] for base in type(error).__mro__ if base.__name__ in ERRORS), Internal)


def to_detail(error: BaseException) -> pb.ErrorDetail:
    """What the wire says about an exception; of an unexpected one its type alone: its text may hold what is private."""
    cls = class_of(error)
    if cls is Internal and not isinstance(error, Internal):
        return pb.ErrorDetail(name=cls.__name__, message=f"internal error ({type(error).__name__})")
    return pb.ErrorDetail(
        name=cls.__name__,
        field=getattr(error, "field", ""),
        expected=getattr(error, "expected", ""),
        got=getattr(error, "got", ""),
        message=str(error),
        retry_after=getattr(error, "retry_after", 0.0),
    )


def to_metadata(detail: pb.ErrorDetail) -> tuple[tuple[str, bytes], ...]:
    """Trailing metadata of a gRPC call that ends with this error."""
    return ((ERROR_METADATA_KEY, detail.SerializeToString()),)


def from_detail(detail: pb.ErrorDetail) -> ServiceError:
    """The exception that a client raises. A name that this version does not know gives :class:`ServiceError` itself."""
    return ERRORS.get(detail.name, ServiceError)(
        detail.message or detail.name,
        field=detail.field,
        expected=detail.expected,
        got=detail.got,
        retry_after=detail.retry_after,
    )


def from_rpc_error(error: grpc.RpcError) -> ServiceError:
    """The exception for a failed gRPC call: by its detail, or by its status code where gRPC itself refused."""
    for key, value in error.trailing_metadata() or ():
        if key == ERROR_METADATA_KEY:
            return from_detail(pb.ErrorDetail.FromString(value))
    cls = next((cls for cls in ERRORS.values() if cls.status is error.code()), Internal)
    return cls(error.details() or cls.__doc__)


def first_line(error: BaseException) -> str:
    """What an error of another library says, short enough to be part of a sentence."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _from_state(cls: type[ServiceError], message: str, state: dict) -> ServiceError:
    error = cls(message)
    error.__dict__.update(state)
    return error

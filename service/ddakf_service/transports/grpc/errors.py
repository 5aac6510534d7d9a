"""Errors over gRPC as clients of any language read them: ``google.rpc.Status`` with its details, beside our own.

Status and trailers share the 8 KiB that gRPC takes for the headers of an answer. Texts are cut so that the worst of them
fit: each is there up to four times, in base64 or percent-encoded.
"""

from __future__ import annotations

import re
from typing import TypeVar

import grpc
from ddakf_api.errors import ServiceError, class_of, to_detail, to_metadata
from ddakf_api.v1 import tracking_pb2 as pb
from google.rpc import error_details_pb2, status_pb2

from ..truncation import truncated

E = TypeVar("E", bound=BaseException)

DOMAIN = "ddakf"
_KEY = "grpc-status-details-bin"
_MOST_BYTES = {"message": 600, "field": 150, "expected": 250, "got": 250}


def shortened(detail: pb.ErrorDetail) -> pb.ErrorDetail:
    """The detail as far as the headers can hold it."""
    short = pb.ErrorDetail()
    short.CopyFrom(detail)
    for field, most in _MOST_BYTES.items():
        setattr(short, field, truncated(getattr(detail, field), most))
    return short


def trailers(detail: pb.ErrorDetail, error: type[ServiceError]) -> tuple[tuple[str, bytes], ...]:
    """Trailing metadata of a call that ends with this error: ``ddakf-error-bin`` and ``grpc-status-details-bin``."""
    return (*to_metadata(detail), (_KEY, rich_status(detail, error).SerializeToString()))


def rich_status(detail: pb.ErrorDetail, error: type[ServiceError]) -> status_pb2.Status:
    """ErrorInfo with the error's name as reason; BadRequest where a field is at fault; RetryInfo where waiting helps."""
    reason = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", detail.name).upper()
    details = [error_details_pb2.ErrorInfo(reason=reason, domain=DOMAIN, metadata=_metadata(detail))]
    if detail.field and error.status is grpc.StatusCode.INVALID_ARGUMENT:
        violation = error_details_pb2.BadRequest.FieldViolation(field=detail.field, description=detail.message, reason=reason)
        details.append(error_details_pb2.BadRequest(field_violations=[violation]))
    if detail.retry_after:
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromMilliseconds(round(1000 * detail.retry_after))
        details.append(retry)
    status = status_pb2.Status(code=error.status.value[0], message=detail.message)
    for message in details:
        status.details.add().Pack(message)
    return status


def _metadata(detail: pb.ErrorDetail) -> dict[str, str]:
    return {name: value for name in ("field", "expected", "got") if (value := getattr(detail, name))}


async def abort(context: grpc.aio.ServicerContext, error: Exception) -> None:
    """Not to be called while the error is handled, which gRPC would keep then."""
    detail, cls = shortened(to_detail(error)), class_of(error)
    await context.abort(cls.status, detail.message, trailers(detail, cls))


def without_traceback(error: E) -> E:
    """The same error without its frames and those that led to it.

    Frames hold requests and sessions, megabytes, and whoever keeps an error that came through them makes a cycle, which stays
    until the collector of cycles finds it: after hundreds of such requests."""
    error.__cause__ = error.__context__ = None
    return error.with_traceback(None)

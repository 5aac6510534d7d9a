"""gRPC errors: ``google.rpc.Status`` with details for clients of any language, beside the service's own detail.

Status and trailers share gRPC's 8 KiB of response headers. Each text occurs up to four times, in base64 or percent-encoded;
texts are truncated so that the longest fit.
"""

from __future__ import annotations

import asyncio
import re
from contextlib import suppress
from typing import TypeVar

import grpc
from ddakf_api.errors import ServiceError, class_of, to_detail, to_metadata
from ddakf_api.v1 import tracking_pb2 as pb
from google.rpc import error_details_pb2, status_pb2

from ..truncation import truncated

E = TypeVar("E", bound=BaseException)

DOMAIN = "ddakf"
_KEY = "grpc-status-details-bin"
_MAX_BYTES = {"message": 600, "field": 150, "expected": 250, "got": 250}


def shortened(detail: pb.ErrorDetail) -> pb.ErrorDetail:
    """The detail with its texts truncated to the size of the headers."""
    short = pb.ErrorDetail()
    short.CopyFrom(detail)
    for field, max_bytes in _MAX_BYTES.items():
        setattr(short, field, truncated(getattr(detail, field), max_bytes))
    return short


def trailers(detail: pb.ErrorDetail, error: type[ServiceError]) -> tuple[tuple[str, bytes], ...]:
    """Trailing metadata of a failed call: ``ddakf-error-bin`` and ``grpc-status-details-bin``."""
    return (*to_metadata(detail), (_KEY, rich_status(detail, error).SerializeToString()))


def rich_status(detail: pb.ErrorDetail, error: type[ServiceError]) -> status_pb2.Status:
    """Status with ErrorInfo (the error's name as reason), BadRequest for an invalid field, RetryInfo for a retryable error."""
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
    """Aborts the call. Call it outside the ``except`` block: gRPC would keep the handled error.

    Raises:
        grpc.aio.AbortError: always, for gRPC. asyncio.CancelledError: the client has cut the call off meanwhile.
    """
    detail, cls = shortened(to_detail(error)), class_of(error)
    with suppress(grpc.aio.InternalError):  # the status cannot be sent any more: gRPC would log it as a defect
        await context.abort(cls.status, detail.message, trailers(detail, cls))
    raise asyncio.CancelledError


def without_traceback(error: E) -> E:
    """The error without its traceback, cause and context.

    A traceback refers to Python frames with requests and sessions, megabytes. A stored error forms a reference cycle with
    them, which the garbage collector finds only after hundreds of such requests.
    """
    error.__cause__ = error.__context__ = None
    return error.with_traceback(None)

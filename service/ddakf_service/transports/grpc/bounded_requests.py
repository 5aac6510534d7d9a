"""Bounded requests: time limit and number of elements of a gRPC request, checked before it is parsed."""

from __future__ import annotations

import asyncio
import functools

import grpc
from ddakf_api.errors import (
    DeadlineExceeded,
    InvalidArgument,
    MessageTooLarge,
    ServiceError,
)
from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from ...sessions.responses.response import Response
from ...streaming.frame_message import TrackRequest
from ..bounded_parsing import parse
from ..track_requests import read_track_request
from .errors import abort

_SERVICE = pb.DESCRIPTOR.services_by_name["TrackingService"]


class BoundedRequests(grpc.aio.ServerInterceptor):
    """Interceptor that limits the time of a unary request and counts the elements of every request before it is parsed.

    The method receives the error in place of a rejected request. Track receives its requests as
    :data:`~ddakf_service.streaming.frame_message.TrackRequest`; responses of a stream are of class :class:`Response`.

    Args:
        patience: seconds for a unary request to arrive.
    """

    def __init__(self, patience: float):
        self._patience = patience

    async def intercept_service(self, continuation, details):
        handler = await continuation(details)
        if handler is None:
            return None
        service, _, name = details.method.rpartition("/")
        if service == f"/{_SERVICE.full_name}":
            method = _SERVICE.methods_by_name[name]
            kind = GetMessageClass(method.input_type)
            handler = handler._replace(request_deserializer=functools.partial(_read_or_refuse, kind))
            if method.output_type is pb.TrackResponse.DESCRIPTOR:
                handler = handler._replace(response_serializer=Response.serialised)
        return handler if handler.request_streaming else _read_in_time(handler, self._patience)


def _read_in_time(handler: grpc.RpcMethodHandler, patience: float) -> grpc.RpcMethodHandler:
    """A unary method as a method of a request stream: gRPC waits without limit for a unary request, never for a stream."""
    call = handler.unary_stream or handler.unary_unary

    async def read(context):
        try:
            async with asyncio.timeout(patience):
                request = await context.read()
        except TimeoutError:
            failure = DeadlineExceeded(f"the request did not come within {patience:g} s")
        else:
            if request is not grpc.aio.EOF:
                return request
            failure = InvalidArgument(field="message", expected="one", got="none")
        await abort(context, failure)

    async def read_and_call(_, context):
        return await call(await read(context), context)  # no local: only the call's own Python frame refers to the request

    method_kind = "stream_stream" if handler.response_streaming else "stream_unary"
    return handler._replace(request_streaming=True, unary_unary=None, unary_stream=None, **{method_kind: read_and_call})


def _read_or_refuse(kind: type[Message], data: bytes) -> Message | TrackRequest | ServiceError:
    """The request of these bytes, or the error: gRPC would answer an exception raised here with UNKNOWN."""
    try:
        return read_track_request(data) if kind is pb.TrackRequest else parse(kind, data)
    except MessageTooLarge as error:
        return error
    except DecodeError:
        expected = f"a serialised {kind.DESCRIPTOR.name}"
        return InvalidArgument(field="message", expected=expected, got=f"{len(data)} bytes of another kind")

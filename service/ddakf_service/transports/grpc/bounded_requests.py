"""Bounded requests: time limits and size limits of gRPC requests before they are parsed."""

from __future__ import annotations

import asyncio
import functools

import grpc
from ddakf_api.errors import (
    DeadlineExceeded,
    InvalidArgument,
    MessageTooLarge,
)
from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from ..bounded_parsing import parsed
from .errors import abort

_SERVICE = pb.DESCRIPTOR.services_by_name["TrackingService"]


class BoundedRequests(grpc.aio.ServerInterceptor):
    """Has the one request of a call come in time, and looks at those of the service before they are parsed. One that is refused
    then reaches its method as the error.

    Args:
        patience: seconds.
    """

    def __init__(self, patience: float):
        self._patience = patience

    async def intercept_service(self, continuation, details):
        handler = await continuation(details)
        if handler is None:
            return None
        service, _, name = details.method.rpartition("/")
        if service == f"/{_SERVICE.full_name}":
            kind = GetMessageClass(_SERVICE.methods_by_name[name].input_type)
            handler = handler._replace(request_deserializer=functools.partial(_parsed, kind))
        return handler if handler.request_streaming else _read_in_time(handler, self._patience)


def _read_in_time(handler: grpc.RpcMethodHandler, patience: float) -> grpc.RpcMethodHandler:
    """The method of one request as one of a stream of requests: those gRPC leaves to be read, and waits for no other for ever."""
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
        return await call(await read(context), context)  # so that no frame but the call's own keeps the request

    way = "stream_stream" if handler.response_streaming else "stream_unary"
    return handler._replace(request_streaming=True, unary_unary=None, unary_stream=None, **{way: read_and_call})


def _parsed(kind: type[Message], data: bytes) -> Message | MessageTooLarge:
    try:
        return parsed(kind, data)
    except MessageTooLarge as error:  # what is raised here gRPC answers by itself, as UNKNOWN
        return error

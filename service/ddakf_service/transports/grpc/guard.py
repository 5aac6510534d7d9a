"""gRPC guard: the key and scopes of every call."""

from __future__ import annotations

import functools
from collections.abc import Callable
from urllib.parse import unquote

import grpc
from ddakf_api.errors import ServiceError

from ...auth.guard import ADMIN, GRPC_SCOPES, Guard, bearer_key
from ...auth.principal import current_principal
from .errors import abort, without_traceback


class GrpcGuard(grpc.aio.ServerInterceptor):
    """Interceptor in front of every gRPC method."""

    def __init__(self, guard: Guard):
        self._guard = guard

    async def intercept_service(self, continuation, details):
        handler = await continuation(details)
        if handler is None:
            return None
        headers = dict(details.invocation_metadata or ())
        sufficient = GRPC_SCOPES.get(details.method, ADMIN)
        presented_key = bearer_key(headers.get("authorization"))
        try:
            principal = await self._guard.admit(presented_key, sufficient, headers)
        except ServiceError as error:
            refused = without_traceback(error)
            return _refusing(refused, functools.partial(self._guard.refusals.record, refused, presented_key, details.method))
        current_principal.set(principal)
        return handler


def _refusing(error: ServiceError, record: Callable[[str], None]) -> grpc.RpcMethodHandler:
    """A handler that refuses a call of any kind. As a stream handler it reads no request.

    Args:
        record: called with the address of the caller.
    """

    async def refuse(requests, context):
        record(unquote(context.peer()))
        await abort(context, error)
        yield

    return grpc.stream_stream_rpc_method_handler(refuse)

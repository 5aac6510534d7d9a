"""The one place where a call is let through or refused, for gRPC, REST and WebSocket alike.

What is not named in a table here needs the scope ``admin``: a new call is closed until somebody opens it.
"""

from __future__ import annotations

import json
import math
from http import HTTPStatus

import grpc
from ddakf_api.errors import PermissionDenied, ServiceError, Unauthenticated, class_of, to_detail, to_metadata
from ddakf_api.v1 import tracking_pb2 as pb

from .keys import KeyRing
from .principal import ANONYMOUS, Principal, Scope, current_principal

_SERVICE = "/" + pb.DESCRIPTOR.services_by_name["TrackingService"].full_name + "/"
GRPC_SCOPES: dict[str, Scope | None] = {
    _SERVICE + "GetServerInfo": None,
    "/grpc.health.v1.Health/Check": None,
    "/grpc.health.v1.Health/Watch": None,
    "/grpc.health.v1.Health/List": None,
    **{_SERVICE + name: Scope.READ for name in ("GetSession", "ListSessions", "WatchSession", "GetSessionHistory")},
    **{_SERVICE + name: Scope.STREAM for name in ("CreateSession", "RestoreSession", "Track")},
    **{_SERVICE + name + "Session": Scope.STREAM for name in ("Update", "Reset", "Delete", "Snapshot")},
}
"""Scope by method; None: open to all. READ stands for whoever may read something, their own sessions at least."""

OPEN_PATHS = frozenset({"/healthz", "/readyz", "/v1/info", "/docs", "/docs/oauth2-redirect", "/redoc", "/openapi.json"})
_SUBPROTOCOL = "ddakf.key."


class Guard:
    """Finds out who calls, and whether they may.

    Args:
        keys: those in force.
        anonymous: calls without a key are anyone's, and allowed everything.
    """

    def __init__(self, keys: KeyRing, *, anonymous: bool):
        self._keys, self._anonymous = keys, anonymous

    async def admit(self, presented: str | None, scope: Scope | None) -> Principal:
        """Who presents this key, if they may do what needs the scope.

        Raises:
            Unauthenticated: no key where one is needed, or one that is not known: an open call is refused with that as well.
            PermissionDenied: the key's scopes do not include this.
        """
        if presented is None:
            if self._anonymous or scope is None:
                return ANONYMOUS
            raise Unauthenticated("a key is needed: send it as 'authorization: Bearer KEY'")
        principal = await self._keys.principal(presented)
        # a holder of the scope stream may read sessions of their own: which these are is known where sessions are found
        sufficient = (scope, Scope.STREAM) if scope is Scope.READ else (scope,)
        if scope is not None and not any(principal.allows(s) for s in sufficient):
            raise PermissionDenied(f"this needs a key with the scope {scope}")
        return principal


def _bearer(value: str | None) -> str | None:
    """The key of an authorization header; what is none is presented as it is, and refused as unknown."""
    if value is None:
        return None
    kind, _, key = value.partition(" ")
    return key.strip() if kind.lower() == "bearer" else value


class GrpcGuard(grpc.aio.ServerInterceptor):
    """Before every gRPC method."""

    def __init__(self, guard: Guard):
        self._guard = guard

    async def intercept_service(self, continuation, details):
        handler = await continuation(details)
        if handler is None:
            return None
        presented = _bearer(dict(details.invocation_metadata or ()).get("authorization"))
        try:
            principal = await self._guard.admit(presented, GRPC_SCOPES.get(details.method, Scope.ADMIN))
        except ServiceError as error:
            return _refusing(handler, error)
        current_principal.set(principal)
        return handler


def _refusing(handler: grpc.RpcMethodHandler, error: ServiceError) -> grpc.RpcMethodHandler:
    """A handler of the same kind that says why not."""
    detail = to_detail(error)

    async def unary(request, context):
        await context.abort(class_of(error).status, detail.message, to_metadata(detail))

    async def stream(request, context):
        await context.abort(class_of(error).status, detail.message, to_metadata(detail))
        yield

    kinds = {
        (False, False): grpc.unary_unary_rpc_method_handler,
        (False, True): grpc.unary_stream_rpc_method_handler,
        (True, False): grpc.stream_unary_rpc_method_handler,
        (True, True): grpc.stream_stream_rpc_method_handler,
    }
    make = kinds[handler.request_streaming, handler.response_streaming]
    behaviour = stream if handler.response_streaming else unary
    return make(behaviour, handler.request_deserializer, handler.response_serializer)


class HttpGuard:
    """ASGI middleware before every route and every WebSocket.

    A browser's WebSocket cannot send headers: it names its key as a subprotocol, ``ddakf.key.KEY``.
    """

    def __init__(self, app, guard: Guard):
        self._app, self._guard = app, guard

    async def __call__(self, scope, receive, send) -> None:
        if scope["type"] not in ("http", "websocket") or scope.get("method") == "OPTIONS":
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        presented = _bearer(headers.get("authorization"))
        if presented is None and scope["type"] == "websocket":
            presented = next((p.removeprefix(_SUBPROTOCOL) for p in scope["subprotocols"] if p.startswith(_SUBPROTOCOL)), None)
        try:
            principal = await self._guard.admit(presented, http_scope(scope))
        except ServiceError as error:
            await _refuse(scope, receive, send, error)
            return
        token = current_principal.set(principal)
        try:
            await self._app(scope, receive, send)
        finally:
            current_principal.reset(token)


def http_scope(scope) -> Scope | None:
    """What a request needs: reading is for GET and for watchers, what changes something for those who stream."""
    path = scope["path"].rstrip("/") or "/"
    if path in OPEN_PATHS:
        return None
    sessions = path == "/v1/sessions" or path.startswith("/v1/sessions/")
    if scope["type"] == "websocket":
        if sessions and path.endswith("/watch"):
            return Scope.READ
        return Scope.STREAM if sessions and path.endswith("/stream") else Scope.ADMIN
    if path == "/metrics" and scope["method"] in ("GET", "HEAD"):
        return Scope.READ
    if not sessions:
        return Scope.ADMIN
    if path.endswith("/snapshot"):
        return Scope.STREAM  # whoever has it can have the session elsewhere
    return Scope.READ if scope["method"] in ("GET", "HEAD") else Scope.STREAM


async def _refuse(scope, receive, send, error: ServiceError) -> None:
    detail, status = to_detail(error), class_of(error).http_status
    if scope["type"] == "websocket":
        await receive()  # the connect event
        await send({"type": "websocket.close", "code": 4000 + status, "reason": detail.message[:120]})
        return
    body = json.dumps({field.name: getattr(detail, field.name) for field in detail.DESCRIPTOR.fields}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if status == HTTPStatus.UNAUTHORIZED:
        headers.append((b"www-authenticate", b"Bearer"))
    if detail.retry_after:
        headers.append((b"retry-after", str(math.ceil(detail.retry_after)).encode()))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})

"""The one place where a call is let through or refused, for gRPC, REST and WebSocket alike.

What is not named in a table here needs the scope ``admin``: a new call is closed until somebody opens it.
"""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus

import grpc
from ddakf_api.errors import PermissionDenied, ServiceError, Unauthenticated, class_of, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ..origins import is_own_name
from ..rest_errors import error_response
from ..status_details import trailers
from .keys import KeyRing
from .principal import ANONYMOUS, Principal, Scope, current_principal

_SERVICE = "/" + pb.DESCRIPTOR.services_by_name["TrackingService"].full_name + "/"
OPEN: frozenset[Scope] = frozenset()  # nobody is asked for a key
READ, STREAM, ADMIN = (frozenset({scope}) for scope in (Scope.READ, Scope.STREAM, Scope.ADMIN))
READ_OWN = frozenset({Scope.READ, Scope.STREAM})  # those who stream may read what is theirs
GRPC_SCOPES: dict[str, frozenset[Scope]] = {
    _SERVICE + "GetServerInfo": OPEN,
    "/grpc.health.v1.Health/Check": OPEN,
    "/grpc.health.v1.Health/Watch": OPEN,
    "/grpc.health.v1.Health/List": OPEN,
    **{_SERVICE + name: READ_OWN for name in ("GetSession", "ListSessions", "WatchSession", "GetSessionHistory")},
    **{_SERVICE + name: STREAM for name in ("CreateSession", "RestoreSession", "Track")},
    **{_SERVICE + name + "Session": STREAM for name in ("Update", "Reset", "Delete", "Snapshot")},
}
"""By method the scopes of which one is enough."""

OPEN_PATHS = frozenset({"/healthz", "/readyz", "/v1/info", "/docs", "/docs/oauth2-redirect", "/redoc", "/openapi.json"})
_SUBPROTOCOL = "ddakf.key."
_FORWARDING = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip")


class Guard:
    """Finds out who calls, and whether they may.

    Args:
        keys: those in force.
        anonymous: calls without a key are anyone's, and allowed everything.
        local: but only those of this machine, not what a proxy forwards, nor a page whose name was made to point here.
    """

    def __init__(self, keys: KeyRing, *, anonymous: bool, local: bool):
        self._keys, self._anonymous, self._local = keys, anonymous, local

    async def admit(self, presented: str | None, enough: frozenset[Scope], headers: Mapping[str, str]) -> Principal:
        """Who presents this key, if they have one of the scopes that are enough; what is theirs is known to the sessions.

        Args:
            presented: the key; None: no key.
            headers: of the call, in lower case.

        Raises:
            Unauthenticated: no key where one is needed, or one that is not known, even where none is needed.
            PermissionDenied: the key's scopes do not include this.
        """
        if presented is None:
            elsewhere = _elsewhere(headers) if self._local else ""
            if not enough or (self._anonymous and not elsewhere):
                return ANONYMOUS
            raise Unauthenticated(f"a key is needed{elsewhere}: send it as 'authorization: Bearer KEY'")
        principal = await self._keys.principal(presented)
        if enough and not any(principal.allows(scope) for scope in enough):
            raise PermissionDenied(f"this needs a key with the scope {' or '.join(sorted(enough))}")
        return principal


def _elsewhere(headers: Mapping[str, str]) -> str:
    """Why a call that comes over loopback may be of somebody elsewhere; empty: it is not."""
    if proxied := next((name for name in _FORWARDING if name in headers), ""):
        return f", as a proxy has forwarded this ({proxied})"
    host = headers.get("host", "")
    if not host or "origin" in headers:  # of a page that says whose it is; see OriginCheck
        return ""
    return "" if is_own_name(host) else f", as this was sent to {host[:80]!r} (allow_anonymous lets it in)"


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
        headers = dict(details.invocation_metadata or ())
        enough = GRPC_SCOPES.get(details.method, ADMIN)
        try:
            principal = await self._guard.admit(_bearer(headers.get("authorization")), enough, headers)
        except ServiceError as error:
            return _refusing(error)
        current_principal.set(principal)
        return handler


def _refusing(error: ServiceError) -> grpc.RpcMethodHandler:
    """A handler for a method of any kind that says why not. As one of streams it reads nothing of what was sent."""
    detail, cls = to_detail(error), class_of(error)

    async def refuse(requests, context):
        await context.abort(cls.status, detail.message, trailers(detail, cls))
        yield

    return grpc.stream_stream_rpc_method_handler(refuse)


class HttpGuard:
    """ASGI middleware before every route and every WebSocket.

    A browser's WebSocket cannot send headers: it names its key as a subprotocol, ``ddakf.key.KEY``, after ``ddakf.v1``.
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
            principal = await self._guard.admit(presented, http_scopes(scope), headers)
        except ServiceError as error:
            await _refuse(scope, receive, send, error)
            return
        token = current_principal.set(principal)
        try:
            await self._app(scope, receive, send)
        finally:
            current_principal.reset(token)


def http_scopes(scope) -> frozenset[Scope]:
    """The scopes of which one is enough: reading is for GET and for watchers, what changes something for those who stream."""
    path = scope["path"].rstrip("/\n") or "/"  # the patterns of routes let one line feed pass at the end
    if path in OPEN_PATHS:
        return OPEN
    sessions = path == "/v1/sessions" or path.startswith(("/v1/sessions/", "/v1/sessions:"))
    reading = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
    if path == "/metrics" and reading:
        return READ
    if not sessions:
        return ADMIN
    if scope["type"] == "websocket":
        return READ_OWN if path.endswith("/watch") else STREAM
    # whoever has a snapshot can have the session elsewhere
    return READ_OWN if reading and not path.endswith("/snapshot") else STREAM


async def _refuse(scope, receive, send, error: ServiceError) -> None:
    response = error_response(error)
    if response.status_code == HTTPStatus.UNAUTHORIZED:
        response.headers["WWW-Authenticate"] = "Bearer"
    await response(scope, receive, send)

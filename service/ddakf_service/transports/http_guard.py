"""HTTP guard: the key and scopes of every REST call and every WebSocket."""

from __future__ import annotations

from http import HTTPStatus

from ddakf_api.errors import ServiceError

from ..auth.guard import Guard, bearer_key, http_scopes
from ..auth.principal import current_principal
from .rest.errors import error_response
from .truncation import call_of, peer_of

_SUBPROTOCOL = "ddakf.key."


class HttpGuard:
    """ASGI middleware in front of every route and every WebSocket.

    A browser's WebSocket cannot send headers: it sends its key as a subprotocol, ``ddakf.key.KEY``, after ``ddakf.v1``.
    """

    def __init__(self, app, guard: Guard):
        self._app, self._guard = app, guard

    async def __call__(self, scope, receive, send) -> None:
        if scope["type"] not in ("http", "websocket") or scope.get("method") == "OPTIONS":
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        presented_key = bearer_key(headers.get("authorization"))
        if presented_key is None and scope["type"] == "websocket":
            keys = (p.removeprefix(_SUBPROTOCOL) for p in scope["subprotocols"] if p.startswith(_SUBPROTOCOL))
            presented_key = next(keys, None)
        try:
            principal = await self._guard.admit(presented_key, http_scopes(scope), headers)
        except ServiceError as error:
            self._guard.refusals.record(error, presented_key, call_of(scope), peer_of(scope))
            await _refuse(scope, receive, send, error)
            return
        token = current_principal.set(principal)
        try:
            await self._app(scope, receive, send)
        finally:
            current_principal.reset(token)


async def _refuse(scope, receive, send, error: ServiceError) -> None:
    response = error_response(error)
    if response.status_code == HTTPStatus.UNAUTHORIZED:
        response.headers["WWW-Authenticate"] = "Bearer"
    await response(scope, receive, send)

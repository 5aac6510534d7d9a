"""Cross-origin rules: web pages of foreign origins are rejected, unless the setting ``cors_origins`` names them.

Without this check any visited page could call the service on the visitor's machine. A browser sends simple requests and opens
WebSockets across origins. CORS only prevents the page from reading the responses to simple requests.
"""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlsplit

from ddakf_api.errors import PermissionDenied
from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ...auth.guard import is_own_name
from .errors import error_response

ANY = "*"
_DOCUMENTATION = ("/docs", "/redoc")
_DEFAULT_POLICY = "default-src 'none'; frame-ancestors 'none'"
# The sources that FastAPI's documentation pages load.
_DOCUMENTATION_POLICY = (
    "default-src 'none'; frame-ancestors 'none'; connect-src 'self' ws: wss:; "
    "script-src https://cdn.jsdelivr.net 'unsafe-inline'; "
    "style-src https://cdn.jsdelivr.net https://fonts.googleapis.com 'unsafe-inline'; font-src https://fonts.gstatic.com; "
    "img-src data: https://fastapi.tiangolo.com https://cdn.redoc.ly; worker-src blob:"
)
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def add_origin_check(app: FastAPI, allowed: Sequence[str]) -> None:
    """Rejects foreign origins on every route; adds CORS headers for the allowed ones."""
    if allowed:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=list(allowed),
            allow_methods=["GET", "POST", "PATCH", "DELETE"],
            allow_headers=["Authorization", "Content-Type"],
            expose_headers=["Content-Disposition", "Location", "Retry-After"],
        )
    app.add_middleware(OriginCheck, allowed=frozenset(allowed))


class OriginCheck:
    """Answers requests and WebSocket handshakes of foreign origins with 403. A call without an origin is no web page's."""

    def __init__(self, app: ASGIApp, allowed: frozenset[str]):
        self._app, self._allowed = app, allowed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope) if scope["type"] in ("http", "websocket") else {}
        origin = headers.get("origin")
        if origin is None or self._is_allowed(origin, headers.get("host", "")):
            await self._app(scope, receive, send)
            return
        error = PermissionDenied(f"pages of {origin[:80]} may not use this service: the setting cors_origins does not name it")
        await error_response(error)(scope, receive, send)

    def _is_allowed(self, origin: str, host: str) -> bool:
        return ANY in self._allowed or origin in self._allowed or _is_own(origin, host)


def _is_own(origin: str, host: str) -> bool:
    """Whether a page comes from this server. A host name does not count: any name may be made to resolve to this machine."""
    try:
        return urlsplit(origin).netloc == host.lower() and is_own_name(host)
    except ValueError:
        return False


class SecurityHeaders:
    """Adds security headers to every HTTP response: no content sniffing, framing, caching or referrer."""

    def __init__(self, app: ASGIApp):
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = MutableHeaders(raw=message.setdefault("headers", []))
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                policy = _DOCUMENTATION_POLICY if scope["path"].startswith(_DOCUMENTATION) else _DEFAULT_POLICY
                headers["Content-Security-Policy"] = policy
                if scope["scheme"] in ("https", "wss"):
                    headers["Strict-Transport-Security"] = "max-age=31536000"
            await send(message)

        await self._app(scope, receive, send_with_headers)

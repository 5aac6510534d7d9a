"""Cross-origin rules: web pages of foreign origins are rejected, unless the setting ``cors_origins`` names them.

Without this check any visited page could call the service on the visitor's machine. A browser sends simple requests and opens
WebSockets across origins. CORS only prevents the page from reading the responses to simple requests.
"""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlsplit

from ddakf_api.errors import PermissionDenied
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ...auth.guard import is_own_name
from ...auth.refusals import FOREIGN_PAGE, Refusals
from ..truncation import call_of, peer_of
from .errors import error_response
from .pages import documentation
from .responses import LAST_SEQUENCE_NUMBER

ANY = "*"
_DEFAULT_POLICY = "default-src 'none'; frame-ancestors 'none'"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def origin_checked(app: ASGIApp, allowed: Sequence[str], refusals: Refusals) -> ASGIApp:
    """The application without pages of foreign origins, and with CORS headers for the allowed ones, which then can also read
    why a call was refused."""
    if allowed:
        app = CORSMiddleware(
            app,
            allow_origins=list(allowed),
            allow_methods=["GET", "POST", "PATCH", "DELETE"],
            allow_headers=["Authorization", "Content-Type", "If-Match"],
            expose_headers=["Content-Disposition", "Location", "Retry-After", LAST_SEQUENCE_NUMBER],
        )
    return OriginCheck(app, frozenset(allowed), refusals)


class OriginCheck:
    """Answers requests and WebSocket handshakes of foreign origins with 403. A call without an origin is no web page's."""

    def __init__(self, app: ASGIApp, allowed: frozenset[str], refusals: Refusals):
        self._app, self._allowed, self._refusals = app, allowed, refusals

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope) if scope["type"] in ("http", "websocket") else {}
        origin = headers.get("origin")
        if origin is None or self._is_allowed(origin, headers.get("host", "")):
            await self._app(scope, receive, send)
            return
        error = PermissionDenied(f"pages of {origin[:80]} may not use this service: the setting cors_origins does not name it")
        self._refusals.record(error, None, call_of(scope), peer_of(scope), FOREIGN_PAGE)
        await error_response(error)(scope, receive, send)

    def _is_allowed(self, origin: str, host: str) -> bool:
        return ANY in self._allowed or origin in self._allowed or _is_own(origin, host)


def _is_own(origin: str, host: str) -> bool:
    """Whether a page comes from this server. A host name does not count: any name may be made to resolve to this machine."""
    try:
        return urlsplit(origin).netloc == host.lower() and is_own_name(host)
    except ValueError:
        return False


def security_headers(path: str, scheme: str) -> dict[str, str]:
    """The security headers of a response."""
    policy = documentation.POLICY if path == documentation.PATH else _DEFAULT_POLICY
    encrypted = scheme in ("https", "wss")
    return (
        _HEADERS | {"Content-Security-Policy": policy} | ({"Strict-Transport-Security": "max-age=31536000"} if encrypted else {})
    )


class SecurityHeaders:
    """Adds security headers to every HTTP response: no content sniffing, framing, caching or referrer."""

    def __init__(self, app: ASGIApp):
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = MutableHeaders(raw=message.setdefault("headers", []))
                for name, value in security_headers(scope["path"], scope["scheme"]).items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, send_with_headers)

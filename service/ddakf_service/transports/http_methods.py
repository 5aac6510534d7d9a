"""HTTP methods and framing that hold for every route: HEAD, and requests whose length is given twice."""

from __future__ import annotations

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send


class HttpMethods:
    """ASGI middleware. HEAD is answered as GET; the server's protocol leaves out the body.

    RFC 9112, 6.1: a request with Content-Length and Transfer-Encoding may hide a second one, which another server on its way
    has not seen. The connection ends with the response.
    """

    def __init__(self, app: ASGIApp):
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)

        async def send_and_close(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(raw=message.setdefault("headers", []))["Connection"] = "close"
            await send(message)

        ambiguous = "content-length" in headers and "transfer-encoding" in headers
        method = "GET" if scope["method"] == "HEAD" else scope["method"]
        await self._app({**scope, "method": method}, receive, send_and_close if ambiguous else send)

"""HTTP protocol: uvicorn's on h11, with a time limit per request and errors of the parser as JSON."""

from __future__ import annotations

import asyncio
import sys
from http import HTTPStatus

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from .rest.cross_origin import security_headers
from .rest.errors import http_error_response
from .truncation import truncated

_MAX_REASON_BYTES = 200  # of h11's message; the part that repeats the request is left out


def http_protocol(patience: float) -> type[H11Protocol]:
    """The protocol's class; h11 bounds the headers.

    Args:
        patience: seconds from the connection, or from the first byte of a request, to the end of the request's body; then
            the connection is closed.
    """

    class Protocol(H11Protocol):
        _cutting: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:
            super().connection_made(transport)
            self._await_request()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._await_request()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop_cutting()
            super().connection_lost(exc)

        def send_400_response(self, msg: str) -> None:
            """Answers bytes that are no request, unless a response has begun, and closes the connection."""
            if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
                for event in _refusal(sys.exception(), self.scheme):
                    self.transport.write(self.conn.send(event))
            self.transport.close()

        def _await_request(self) -> None:
            upgraded = self.transport.get_protocol() is not self
            if upgraded or self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
                self._stop_cutting()
            elif self._cutting is None:
                self._cutting = self.loop.call_later(patience, self.transport.close)

        def _stop_cutting(self) -> None:
            if self._cutting is not None:
                self._cutting.cancel()
                self._cutting = None

    return Protocol


def _refusal(error: BaseException | None, scheme: str) -> list[h11.Event]:
    """The response to an error of h11's parser."""
    status, reason = HTTPStatus.BAD_REQUEST, "not a request of HTTP/1.1"
    if isinstance(error, h11.RemoteProtocolError):
        status, reason = (
            HTTPStatus(error.error_status_hint),
            truncated(str(error).partition(": bytearray(")[0], _MAX_REASON_BYTES),
        )
    response = http_error_response(status, f"the request cannot be read: {reason}")
    response.headers.update(security_headers("", scheme))
    headers = [*response.raw_headers, (b"connection", b"close")]
    head = h11.Response(status_code=status, headers=headers, reason=status.phrase.encode())
    return [head, h11.Data(data=bytes(response.body)), h11.EndOfMessage()]

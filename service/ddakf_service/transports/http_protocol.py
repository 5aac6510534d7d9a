"""HTTP protocol: uvicorn's on h11, with bounds on the time of a request, its chunks and unread responses; errors are JSON."""

from __future__ import annotations

import asyncio
import fcntl
import math
import sys
import termios
from http import HTTPStatus
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from .rest.cross_origin import security_headers
from .rest.errors import http_error_response
from .truncation import truncated

_MAX_REASON_BYTES = 200  # of h11's message; the part that repeats the request is left out
_LARGE_READ = 1 << 16  # bytes after which other connections have their turn
MAX_SMALL_CHUNKS = 1 << 10  # chunks of a body beside one per CHUNK_BYTES
CHUNK_BYTES = 128  # a smaller chunk costs more time than its bytes


def http_protocol(patience: float, reader_timeout: float) -> type[H11Protocol]:
    """The protocol's class; h11 bounds the headers.

    Args:
        patience: seconds from the connection, or from the first byte of a request, to the end of the request's body; then
            the connection is closed.
        reader_timeout: seconds in which a client has to read something of a response that waits for it, else the connection is
            aborted.
    """

    class Protocol(H11Protocol):
        _request_timer: asyncio.TimerHandle | None = None
        _reader_timer: asyncio.TimerHandle | None = None

        def __init__(self, *arguments: Any, **options: Any):
            super().__init__(*arguments, **options)
            self.conn = _Connection(h11.SERVER)

        def connection_made(self, transport: asyncio.Transport) -> None:
            super().connection_made(transport)
            self._time_request()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._time_request()
            if len(data) >= _LARGE_READ and self._is_reading():
                self.transport.pause_reading()  # uvloop would go on with megabytes
                self.loop.call_soon(self._read_on)

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop_request_timer()
            self._stop_reader_timer()
            super().connection_lost(exc)

        def pause_writing(self) -> None:
            super().pause_writing()
            self._time_reader()

        def resume_writing(self) -> None:
            self._stop_reader_timer()
            super().resume_writing()

        def send_400_response(self, msg: str) -> None:
            """Answers bytes that are no request, unless a response has begun, and closes the connection."""
            if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
                for event in _refusal(sys.exception(), self.scheme):
                    self.transport.write(self.conn.send(event))
            self.transport.close()

        def _read_on(self) -> None:
            if self._is_reading():
                self.transport.resume_reading()

        def _is_reading(self) -> bool:
            """Whether this protocol has an open connection whose flow control does not hold it back."""
            return not (self.flow.read_paused or self.transport.is_closing()) and self.transport.get_protocol() is self

        def _time_request(self) -> None:
            upgraded = self.transport.get_protocol() is not self
            if upgraded or self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
                self._stop_request_timer()
            elif self._request_timer is None:
                self._request_timer = self.loop.call_later(patience, self.transport.close)

        def _time_reader(self, unread: float = math.inf) -> None:
            """Aborts the connection if the client has read nothing since the last look, at which so many bytes were unread."""
            left = _unread_bytes(self.transport)
            if left >= unread:
                self.transport.abort()  # an orderly end would wait for the client
            else:
                self._reader_timer = self.loop.call_later(reader_timeout, self._time_reader, left)

        def _stop_reader_timer(self) -> None:
            if self._reader_timer is not None:
                self._reader_timer.cancel()
                self._reader_timer = None

        def _stop_request_timer(self) -> None:
            if self._request_timer is not None:
                self._request_timer.cancel()
                self._request_timer = None

    return Protocol


class _Connection(h11.Connection):
    """h11's connection without bodies of tiny chunks: one read has tens of thousands of them."""

    _chunks = _bytes = 0  # of the body so far

    def next_event(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._chunks = self._bytes = 0
        elif isinstance(event, h11.Data):
            self._chunks += event.chunk_end
            self._bytes += len(event.data)
            if self._chunks > MAX_SMALL_CHUNKS + self._bytes // CHUNK_BYTES:
                raise h11.RemoteProtocolError(f"more than {MAX_SMALL_CHUNKS} chunks of fewer than {CHUNK_BYTES} bytes")
        return event


def _unread_bytes(transport: asyncio.Transport) -> int:
    """Bytes that wait here, and in the system's buffer: that one takes more only when a third of it is free."""
    sent = bytearray(4)
    fcntl.ioctl(transport.get_extra_info("socket").fileno(), termios.TIOCOUTQ, sent)
    return transport.get_write_buffer_size() + int.from_bytes(sent, sys.byteorder)


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

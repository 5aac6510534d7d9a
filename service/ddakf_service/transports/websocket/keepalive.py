"""WebSocket protocol: bounds on silence, on small frames and on unread pongs; a refused handshake is answered as JSON."""

from __future__ import annotations

from typing import Any

from uvicorn._types import ASGIReceiveEvent, ASGISendEvent
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode, Frame, Opcode

from ...token_bucket import TokenBucket

_CLOSE_GRACE = 1.0  # seconds for the close frame before the connection is aborted
_PART = 1 << 13  # bytes that are parsed at once; they hold at most a thousand frames
_PARTS_PER_TURN = 8  # parts until other connections have their turn
MAX_SMALL_FRAMES = 500  # per second: pings, pongs and small fragments; no client needs a tenth of them
_BURST = 2.0  # seconds of small frames that may come at once
_SMALL_FRAGMENT = 128  # bytes below which a fragment costs more than its bytes
_MAX_UNREAD_PONGS = 100  # while the client does not read; they have no flow control
_MESSAGES = (Opcode.TEXT, Opcode.BINARY)


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """uvicorn's protocol with another keepalive, bounds on small frames and another end of a refused handshake.

    A client that answers no ping is disconnected even with unread data, which an orderly close would wait for. In two cases
    the ping is repeated instead. The client has sent data since; or it reads its responses, while backpressure of a lossless
    session holds back the frames in front of its pong.

    A frame of six bytes costs as much time as one of kilobytes, and one read has tens of thousands of them. A read is therefore
    parsed in parts, as the application takes the messages. More than :data:`MAX_SMALL_FRAMES` frames that are no messages end
    the connection.
    """

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self._last_received = 0.0  # seconds, the event loop's clock
        self._unparsed = bytearray()
        self._small_frames = TokenBucket(_BURST)
        self._unread_pongs = 0

    def data_received(self, data: bytes) -> None:
        self._last_received = self.loop.time()
        self._unparsed += data
        self._parse()

    def handle_events(self) -> None:
        now = self.loop.time()
        for event in self.conn.events:
            if self._is_bounded(event) and self._small_frames.wait(MAX_SMALL_FRAMES, now):
                self._fail(CloseCode.POLICY_VIOLATION, f"more than {MAX_SMALL_FRAMES} control frames or small fragments a second")
                return
        super().handle_events()

    def send_receive_event_to_app(self) -> None:
        if self.curr_msg_data_type == "text" and not self.close_sent:
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError as error:  # uvicorn would log a traceback and give no reason
                reason = f"message: expected text in UTF-8, got {error.reason} at byte {error.start}"
                self._fail(CloseCode.INVALID_DATA, reason)
                return
        super().send_receive_event_to_app()

    async def receive(self) -> ASGIReceiveEvent:
        message = await super().receive()
        if self._unparsed and not self.read_paused:
            self._parse_later()
        return message

    async def send(self, message: ASGISendEvent) -> None:
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
            self.handshake_complete = True  # uvicorn would log an error, though the refusal is complete
        if message["type"] == "websocket.close" and self._unparsed:
            self._parse_later()  # the client's answer may be there

    def keepalive_timeout(self) -> None:
        held_back = self.read_paused and self.writable.is_set()
        if held_back or self._last_received > self.ping_sent_at:
            self.pong_timer = self.pending_ping_payload = None
            self.schedule_ping()
            return
        super().keepalive_timeout()
        self.loop.call_later(_CLOSE_GRACE, self.transport.abort)

    def handle_ping(self) -> None:
        if not self.writable.is_set():
            self._unread_pongs += 1
            if self._unread_pongs > _MAX_UNREAD_PONGS:
                self.transport.abort()  # an orderly close would wait for the client
                return
        super().handle_ping()

    def resume_writing(self) -> None:
        self._unread_pongs = 0
        super().resume_writing()

    def _parse(self) -> None:
        """Parses some parts of what has come; reading goes on when all of it is parsed."""
        for _ in range(_PARTS_PER_TURN):
            if not self._unparsed or self.read_paused or self.transport.is_closing():
                break
            part = bytes(self._unparsed[:_PART])
            del self._unparsed[:_PART]
            super().data_received(part)
        if self.transport.is_closing():
            self._unparsed.clear()
        elif self._unparsed and not self.read_paused:
            self._parse_later()
        elif not self.read_paused:
            self.transport.resume_reading()

    def _parse_later(self) -> None:
        if not self.transport.is_closing():
            self.transport.pause_reading()
            self.loop.call_soon(self._parse)

    def _is_bounded(self, event: object) -> bool:
        """Whether an event is a frame that flow control does not hold back: no whole message, or one after the close."""
        if not isinstance(event, Frame) or event.opcode is Opcode.CLOSE:
            return False
        if event.opcode in (Opcode.PING, Opcode.PONG) or self.close_sent:
            return True
        whole = event.fin and event.opcode in _MESSAGES
        return not whole and len(event.data) < _SMALL_FRAGMENT

    def _fail(self, code: CloseCode, reason: str) -> None:
        """Closes the connection for an error of the client; before the end of the handshake without a code."""
        if not self.handshake_complete:
            self.transport.abort()
            return
        self.conn.fail(code, reason)
        self.handle_parser_exception()

"""WebSocket protocol: a client that answers no ping is disconnected; a refused handshake is answered as JSON."""

from __future__ import annotations

from uvicorn._types import ASGISendEvent
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

_CLOSE_GRACE = 1.0  # seconds for the close frame before the connection is aborted


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """uvicorn's protocol with another keepalive and another end of a refused handshake.

    A client that answers no ping is disconnected even with unread data, which an orderly close would wait for. In two cases
    the ping is repeated instead. The client has sent data since; or it reads its responses, while backpressure of a lossless
    session holds back the frames in front of its pong.
    """

    _last_received = 0.0  # seconds, the event loop's clock

    def data_received(self, data: bytes) -> None:
        self._last_received = self.loop.time()
        super().data_received(data)

    async def send(self, message: ASGISendEvent) -> None:
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
            self.handshake_complete = True  # uvicorn would log an error, though the refusal is complete

    def keepalive_timeout(self) -> None:
        held_back = self.read_paused and self.writable.is_set()
        if held_back or self._last_received > self.ping_sent_at:
            self.pong_timer = self.pending_ping_payload = None
            self.schedule_ping()
            return
        super().keepalive_timeout()
        self.loop.call_later(_CLOSE_GRACE, self.transport.abort)

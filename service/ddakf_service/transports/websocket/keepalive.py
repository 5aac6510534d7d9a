"""WebSocket keepalive: clients that do not answer a ping are disconnected."""

from __future__ import annotations

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

_LAST_WORDS = 1.0  # seconds that a close frame has to leave before the connection is cut


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """uvicorn's protocol, but for what happens to a client that answers no ping.

    It is cut off even if it has left unread what was sent to it, which an orderly close would wait for. One that has sent
    something since is asked again instead, and so is one that reads its answers while a lossless session holds back the
    frames that its pong lies behind.
    """

    _heard = 0.0  # when something came last, the event loop's clock

    def data_received(self, data: bytes) -> None:
        self._heard = self.loop.time()
        super().data_received(data)

    def keepalive_timeout(self) -> None:
        held_back = self.read_paused and self.writable.is_set()
        if held_back or self._heard > self.ping_sent_at:
            self.pong_timer = self.pending_ping_payload = None
            self.schedule_ping()
            return
        super().keepalive_timeout()
        self.loop.call_later(_LAST_WORDS, self.transport.abort)

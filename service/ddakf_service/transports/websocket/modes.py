"""Message modes of a WebSocket: protobuf in binary frames, or JSON in text frames."""

from __future__ import annotations

import asyncio
from typing import Protocol

from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import WebSocket
from google.protobuf.message import DecodeError

from ...sessions.responses.response import Response
from ...streaming.frame_message import TrackRequest
from ..bounded_parsing import require_bounded_json
from ..dialect.reading import read
from ..dialect.writing import as_json
from ..track_requests import read_track_request, without_frame

_LARGE = 1 << 16  # bytes; JSON of a larger message is written and read in a thread


class Mode(Protocol):
    """Encoding of messages in WebSocket frames."""

    async def read(self, event: dict) -> TrackRequest | None:
        """The request of a received WebSocket frame; None for an empty frame."""

    async def send(self, websocket: WebSocket, response: Response) -> None:
        """Sends a response."""


class Binary:
    """Serialised messages in binary frames."""

    async def read(self, event: dict) -> TrackRequest | None:
        if (data := event.get("bytes")) is None:
            raise InvalidArgument(field="message", expected="a binary frame, or mode=json", got="a text frame")
        try:
            return read_track_request(data) if data else None
        except DecodeError:
            raise InvalidArgument(
                field="message", expected="a serialised TrackRequest", got=f"{len(data)} bytes of another kind"
            ) from None

    async def send(self, websocket: WebSocket, response: Response) -> None:
        await websocket.send_bytes(response.serialised())


class Json:
    """The protobuf JSON mapping in text frames, with the names of the contract; arrays are base64."""

    async def read(self, event: dict) -> TrackRequest | None:
        if (text := event.get("text")) is None:
            raise InvalidArgument(field="message", expected="a text frame in mode=json", got="a binary frame")
        require_bounded_json(text)
        request = await _maybe_in_thread(len(text), read, text, pb.TrackRequest, "message")
        return without_frame(request) if request.WhichOneof("message") else None

    async def send(self, websocket: WebSocket, response: Response) -> None:
        message = response.whole_message()
        await websocket.send_text(await _maybe_in_thread(message.ByteSize(), as_json, message))


MODES: dict[str, Mode] = {"binary": Binary(), "json": Json()}


async def _maybe_in_thread(size: int, function, *arguments):
    """Runs the conversion of a large message in a thread, so that it does not block the event loop."""
    return await asyncio.to_thread(function, *arguments) if size > _LARGE else function(*arguments)

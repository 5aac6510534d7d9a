"""The contract over WebSocket: a session's stream and its watchers, as protobuf in binary frames or as JSON in text frames.

An empty message says that no more frames follow, what half-closing says over gRPC. A stream that ends with an error ends
with the close code 4000 plus the error's HTTP status, and its sentence as the reason.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import re
from typing import Protocol

from ddakf_api.errors import DeadlineExceeded, FailedPrecondition, InvalidArgument, ServiceError, class_of, to_detail
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from google.protobuf import json_format
from google.protobuf.message import DecodeError
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from ddakf import errors as library

from .parts import parsed, require_few_in_json
from .sessions import Sessions
from .stream import Stream
from .truncation import truncated

log = logging.getLogger(__name__)

# What a browser that names its key as a subprotocol names first, because it needs one of them agreed to.
SUBPROTOCOL = "ddakf.v1"
ERROR_CODES = 4000  # plus the HTTP status of the error
_NORMAL = 1000
_MAX_REASON_BYTES = 123  # RFC 6455: a control frame holds 125, two of them the code
_LARGE = 1 << 16  # bytes of a message from which on JSON is written and read in a thread
_LAST_WORDS = 1.0  # seconds that a close frame has to leave before the connection is cut


class Mode(Protocol):
    """How messages look in WebSocket frames."""

    async def parsed(self, event: dict) -> pb.TrackRequest | None:
        """The request in a received frame; None for an empty one."""

    async def send(self, websocket: WebSocket, response: pb.TrackResponse) -> None:
        """Sends an answer."""


class Binary:
    """Serialised messages in binary frames."""

    async def parsed(self, event: dict) -> pb.TrackRequest | None:
        if (data := event.get("bytes")) is None:
            raise InvalidArgument(field="message", expected="a binary frame, or mode=json", got="a text frame")
        try:
            return parsed(pb.TrackRequest, data) if data else None
        except DecodeError:
            raise InvalidArgument(
                field="message", expected="a serialised TrackRequest", got=f"{len(data)} bytes that are none"
            ) from None

    async def send(self, websocket: WebSocket, response: pb.TrackResponse) -> None:
        await websocket.send_bytes(response.SerializeToString())


class Json:
    """The protobuf JSON mapping in text frames, with the names of the contract; arrays are base64."""

    async def parsed(self, event: dict) -> pb.TrackRequest | None:
        if (text := event.get("text")) is None:
            raise InvalidArgument(field="message", expected="a text frame in mode=json", got="a binary frame")
        require_few_in_json(text)
        try:
            request = await _maybe_in_thread(len(text), json_format.Parse, text or "{}", pb.TrackRequest())
        except (json_format.ParseError, RecursionError) as error:
            got = " ".join(str(error).split())
            raise InvalidArgument(field="message", expected="a TrackRequest as JSON", got=got) from None
        return request if request.WhichOneof("message") else None

    async def send(self, websocket: WebSocket, response: pb.TrackResponse) -> None:
        await websocket.send_text(await _maybe_in_thread(response.ByteSize(), _as_json, response))


MODES: dict[str, Mode] = {"binary": Binary(), "json": Json()}


def add_websockets(app: FastAPI, sessions: Sessions, patience: float) -> None:
    """The routes ``/v1/sessions/{id}/stream`` and ``/v1/sessions/{id}/watch``; ``?mode=json`` for text frames.

    Args:
        patience: seconds that a stream's client has to send Start.
    """

    @app.websocket("/v1/sessions/{session_id}/stream")
    async def stream(websocket: WebSocket, session_id: str) -> None:
        await _answering_errors(websocket, functools.partial(_stream, patience=patience), sessions, f"sessions/{session_id}")

    @app.websocket("/v1/sessions/{session_id}/watch")
    async def watch(websocket: WebSocket, session_id: str) -> None:
        await _answering_errors(websocket, _watch, sessions, f"sessions/{session_id}")


async def _answering_errors(websocket: WebSocket, converse, sessions: Sessions, name: str) -> None:
    """Runs a conversation and closes the connection with what it ended with."""
    await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in websocket.scope["subprotocols"] else None)
    code, reason = _NORMAL, ""
    try:
        await converse(websocket, sessions, name)
    except WebSocketDisconnect:
        return
    except (ServiceError, library.DdakfError) as error:
        code, reason = _closing(error)
    except Exception as error:
        log.exception("a WebSocket stream failed")
        code, reason = _closing(error)
    try:
        await websocket.close(code, reason)
    except (WebSocketDisconnect, RuntimeError):
        log.debug("the client had left before it was told %s", code)


async def _stream(websocket: WebSocket, sessions: Sessions, name: str, *, patience: float) -> None:
    mode = _mode(websocket)
    try:
        async with asyncio.timeout(patience):
            start = await _start(websocket, mode, name)
    except TimeoutError:
        raise DeadlineExceeded(f"no start came within {patience:g} s") from None
    stream = await sessions.open_stream(start)
    reader = asyncio.create_task(_read(websocket, mode, stream))
    try:
        await stream.deliver(lambda response: _send(websocket, mode, response))
    finally:
        reader.cancel()
        closing = sessions.leave_stream(stream)
    await asyncio.shield(closing)


async def _start(websocket: WebSocket, mode: Mode, name: str) -> pb.Start:
    request = await mode.parsed(await _receive(websocket))
    if request is None or request.WhichOneof("message") != "start":
        raise FailedPrecondition("the first message of a stream has to be start", field="start")
    if request.start.name not in ("", name):
        raise InvalidArgument(field="start.name", expected=f"{name}, as in the address, or nothing", got=request.start.name)
    request.start.name = name
    return request.start


async def _watch(websocket: WebSocket, sessions: Sessions, name: str) -> None:
    mode, query = _mode(websocket), websocket.query_params
    every_nth = query.get("every_nth", "1")
    if not re.fullmatch("[0-9]{1,9}", every_nth):
        raise InvalidArgument(field="every_nth", expected="a whole number of at most 9 digits", got=repr(every_nth[:80]))
    request = pb.WatchSessionRequest(name=name, api_version=query.get("api_version", ""), every_nth=int(every_nth))
    watcher = sessions.watch(request)

    async def refuse_messages() -> None:
        try:
            await _receive(websocket)
            watcher.close(FailedPrecondition("a watcher only reads", field="message"))
        except WebSocketDisconnect as left:
            watcher.close(left)

    reader = asyncio.create_task(refuse_messages())
    try:
        async for response in watcher.responses():
            await _send(websocket, mode, response)
    finally:
        reader.cancel()
        watcher.leave()


async def _read(websocket: WebSocket, mode: Mode, stream: Stream) -> None:
    """Always reads, but for the time that a lossless session holds its client back."""
    try:
        while (request := await mode.parsed(await _receive(websocket))) is not None:
            await stream.receive(request)
        stream.finish()
        await _receive(websocket)
        raise FailedPrecondition("no message may follow the empty one", field="message")
    except Exception as error:  # the client left, or sent what cannot be used
        stream.end(error)


async def _receive(websocket: WebSocket) -> dict:
    event = await websocket.receive()
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event["code"])
    return event


async def _send(websocket: WebSocket, mode: Mode, response: pb.TrackResponse) -> None:
    try:
        await mode.send(websocket, response)
    except RuntimeError as error:  # the connection was closed beneath: a message too large, no answer to a ping
        raise WebSocketDisconnect() from error


def _mode(websocket: WebSocket) -> Mode:
    name = websocket.query_params.get("mode", "binary")
    if name not in MODES:
        raise InvalidArgument(field="mode", expected=" or ".join(MODES), got=repr(name[:80]))
    return MODES[name]


def _closing(error: Exception) -> tuple[int, str]:
    """The close code of an error, and its sentence as far as it fits."""
    return ERROR_CODES + class_of(error).http_status, truncated(to_detail(error).message, _MAX_REASON_BYTES)


def _as_json(response: pb.TrackResponse) -> str:
    return json_format.MessageToJson(
        response, preserving_proto_field_name=True, always_print_fields_with_no_presence=True, indent=None
    )


async def _maybe_in_thread(size: int, function, *arguments):
    """A large message is converted where it holds up nobody."""
    return await asyncio.to_thread(function, *arguments) if size > _LARGE else function(*arguments)


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

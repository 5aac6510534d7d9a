"""WebSocket routes: a session's stream and its watchers, as protobuf in binary frames or as JSON in text frames.

An empty message marks the end of the frames, as half-closing does over gRPC. A stream that ends with an error sends the error,
and is closed with the code 4000 plus the error's HTTP status and the error's message as the reason: several errors have the same
status, and a page in a browser sees nothing else of a closed connection.
"""

from __future__ import annotations

import asyncio
import functools
import logging
import re

from ddakf_api.errors import DeadlineExceeded, FailedPrecondition, InvalidArgument, ServiceError, class_of, to_detail
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import FastAPI, WebSocket, WebSocketDisconnect

from ddakf import errors as library

from ...sessions.responses.response import Response
from ...streaming.stream import Stream
from ...streaming.streams import Streams
from ..query_parameters import require_known
from ..truncation import printable, truncated
from .modes import MODES, Mode

log = logging.getLogger(__name__)

# The subprotocol that the server accepts. A browser that sends its key as a subprotocol lists this one first.
SUBPROTOCOL = "ddakf.v1"
ERROR_CODES = 4000  # plus the HTTP status of the error
_NORMAL = 1000
_MAX_REASON_BYTES = 123  # RFC 6455: a control frame holds 125, two of them the code


def add_websockets(app: FastAPI, streams: Streams, patience: float) -> None:
    """The routes ``/v1/sessions/{id}/stream`` and ``/v1/sessions/{id}/watch``; ``?mode=json`` for text frames.

    Args:
        patience: seconds for the client of a stream to send Start, and for a watcher to read a response.
    """

    @app.websocket("/v1/sessions/{session_id}/stream")
    async def stream(websocket: WebSocket, session_id: str) -> None:
        converse = functools.partial(_stream, patience=patience)
        await _answering_errors(websocket, converse, streams, f"sessions/{session_id}")

    @app.websocket("/v1/sessions/{session_id}/watch")
    async def watch(websocket: WebSocket, session_id: str) -> None:
        converse = functools.partial(_watch, patience=patience)
        await _answering_errors(websocket, converse, streams, f"sessions/{session_id}")


async def _answering_errors(websocket: WebSocket, converse, streams: Streams, name: str) -> None:
    """Runs a stream or a watcher and closes the connection with the resulting code and reason."""
    await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in websocket.scope["subprotocols"] else None)
    failure = None
    try:
        await converse(websocket, streams, name)
    except WebSocketDisconnect:
        return
    except (ServiceError, library.DdakfError) as error:
        failure = error
    except Exception as error:
        log.exception("a WebSocket stream failed")
        failure = error
    try:
        await _end(websocket, failure)
    except (WebSocketDisconnect, RuntimeError):
        log.debug("the client left before the end of its stream: %s", failure)


async def _end(websocket: WebSocket, failure: Exception | None) -> None:
    """Closes the connection; an error is sent before, in the stream's mode if the address names a mode."""
    if failure is None:
        await websocket.close(_NORMAL)
        return
    detail = to_detail(failure)
    if mode := MODES.get(_mode_name(websocket)):
        await _send(websocket, mode, Response(pb.TrackResponse(error=detail)))
    await websocket.close(ERROR_CODES + class_of(failure).http_status, truncated(detail.message, _MAX_REASON_BYTES))


async def _stream(websocket: WebSocket, streams: Streams, name: str, *, patience: float) -> None:
    mode = _mode(websocket, "mode")
    await streams.require_session(name)  # before the client takes the pains of a start
    try:
        async with asyncio.timeout(patience):
            start = await _start(websocket, mode, name)
    except TimeoutError:
        raise DeadlineExceeded(f"no start came within {patience:g} s") from None
    stream = await streams.open(start)
    reader = asyncio.create_task(_read(websocket, mode, stream))
    try:
        await stream.deliver(lambda response: _send(websocket, mode, response))
    finally:
        reader.cancel()
        closing = streams.leave(stream)
    await asyncio.shield(closing)


async def _start(websocket: WebSocket, mode: Mode, name: str) -> pb.Start:
    request = await mode.read(await _receive(websocket))
    if not isinstance(request, pb.TrackRequest) or not request.HasField("start"):
        raise FailedPrecondition("the first message of a stream has to be start", field="start")
    if request.start.name not in ("", name):
        got = printable(request.start.name)
        raise InvalidArgument(field="start.name", expected=f"{name}, as in the address, or nothing", got=got)
    request.start.name = name
    return request.start


async def _watch(websocket: WebSocket, streams: Streams, name: str, *, patience: float) -> None:
    mode, query = _mode(websocket, "mode", "api_version", "every_nth", "include_frames"), websocket.query_params
    every_nth = query.get("every_nth", "1")
    if not re.fullmatch("[0-9]{1,9}", every_nth):
        raise InvalidArgument(field="every_nth", expected="a whole number of at most 9 digits", got=repr(every_nth[:80]))
    include_frames = query.get("include_frames", "false")
    if include_frames not in ("true", "false"):
        raise InvalidArgument(field="include_frames", expected="true or false", got=repr(include_frames[:80]))
    request = pb.WatchSessionRequest(
        name=name,
        api_version=query.get("api_version", ""),
        every_nth=int(every_nth),
        include_frames=include_frames == "true",
    )
    watcher = await streams.watch(request)

    async def refuse_messages() -> None:
        try:
            await _receive(websocket)
            watcher.close(FailedPrecondition("a watcher only reads", field="message"))
        except WebSocketDisconnect as left:
            watcher.close(left)

    reader = asyncio.create_task(refuse_messages())
    try:
        await watcher.deliver(lambda response: _send(websocket, mode, response), patience)
    finally:
        reader.cancel()
        streams.unwatch(watcher)


async def _read(websocket: WebSocket, mode: Mode, stream: Stream) -> None:
    """Reads at all times, except while backpressure of a lossless session holds the client back."""
    try:
        while (request := await mode.read(await _receive(websocket))) is not None:
            await stream.receive(request)
        stream.finish()
        await _receive(websocket)
        raise FailedPrecondition("no message may follow the empty one", field="message")
    except Exception as error:  # the client left, or the request is invalid
        stream.end(error)


async def _receive(websocket: WebSocket) -> dict:
    event = await websocket.receive()
    if event["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(event["code"])
    return event


async def _send(websocket: WebSocket, mode: Mode, response: Response) -> None:
    try:
        await mode.send(websocket, response)
    except RuntimeError as error:  # the protocol closed the connection: a message too large, no answer to a ping
        raise WebSocketDisconnect() from error


def _mode(websocket: WebSocket, *parameters: str) -> Mode:
    """The mode of a connection whose query may have these parameters."""
    require_known(websocket.query_params, parameters)
    name = _mode_name(websocket)
    if name not in MODES:
        raise InvalidArgument(field="mode", expected=" or ".join(MODES), got=repr(name[:80]))
    return MODES[name]


def _mode_name(websocket: WebSocket) -> str:
    return websocket.query_params.get("mode", "binary")

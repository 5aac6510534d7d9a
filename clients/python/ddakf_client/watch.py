"""Watchers: read the answers of a session's stream beside its own client."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Callable, Iterator

import grpc
from ddakf_api import API_VERSION
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.calls import closing_is_an_error, failure, require_every_nth
from ddakf_client.read_ahead import read_ahead
from ddakf_client.results import FrameError, Notice, Result, frame_error_from, notice_from, result_from

_READ_AHEAD = 1  # answers that may wait for the caller: with more it would see them late


def watch_request(name: str, every_nth: int) -> pb.WatchSessionRequest:
    """The request of ``Session.watch``.

    Raises:
        InvalidArgument: `every_nth` is not an integer of at least 1.
    """
    require_every_nth(every_nth)
    return pb.WatchSessionRequest(name=name, api_version=API_VERSION, every_nth=every_nth)


def watch(call: grpc.Call, on_notice: Callable[[Notice], None], target: str) -> Iterator[Result | FrameError]:
    """Yields answers until the session ends, then raises the reason."""
    try:
        for response, _ in read_ahead(call, _READ_AHEAD):
            yield from _answers(response, on_notice)
    except grpc.RpcError as error:
        raise failure(error, target, math.inf) from None
    finally:
        call.cancel()


async def awatch(
    call: grpc.aio.UnaryStreamCall, on_notice: Callable[[Notice], None], target: str
) -> AsyncIterator[Result | FrameError]:
    """As :func:`watch`."""
    try:
        with closing_is_an_error():
            async for response in call:
                for answer in _answers(response, on_notice):
                    yield answer
    except grpc.RpcError as error:
        raise failure(error, target, math.inf) from None
    finally:
        call.cancel()


def _answers(response: pb.TrackResponse, on_notice: Callable[[Notice], None]) -> Iterator[Result | FrameError]:
    kind = response.WhichOneof("message")
    if kind == "notice":
        on_notice(notice_from(response.notice))
    elif kind == "result":
        yield result_from(response.result, dropped_before_sending=0, latency=math.nan)
    elif kind == "frame_error":
        yield frame_error_from(response.frame_error)

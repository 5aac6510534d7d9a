"""Clients that do not read what they asked for: no answer waits for them for ever."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator

import grpc
import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import ResourceExhausted, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub

from ..conftest import TIMEOUT, frame_of, make_sheet, request_of, serving
from .http_alone import Port, http_alone

READER_TIMEOUT = 0.4  # seconds
PATH, COUNT = "/openapi.json", 60  # of requests at once, whose answers no buffers hold


@pytest.fixture(scope="module")
def port() -> Iterator[Port]:
    with http_alone(reader_timeout=READER_TIMEOUT) as port:
        yield port


@pytest.fixture(scope="module")
def size(port) -> int:
    """Bytes of one answer."""
    return len(httpx.get(f"{port.url}{PATH}").content)


def ask(port: Port) -> socket.socket:
    """A connection with little room for the answers to its requests, the last of which asks for its end."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
    connection.settimeout(TIMEOUT)
    connection.connect(("127.0.0.1", port.number))
    request = f"GET {PATH} HTTP/1.1\r\nHost: 127.0.0.1:{port.number}\r\n"
    connection.sendall((f"{request}\r\n" * (COUNT - 1) + f"{request}Connection: close\r\n\r\n").encode())
    return connection


def read(connection: socket.socket, pause: float = 0.0) -> int:
    """Number of bytes until the end of the connection, with a pause after each read of the first seconds."""
    received, began = 0, time.monotonic()
    with contextlib.suppress(ConnectionResetError):
        while data := connection.recv(1 << 16):
            received += len(data)
            if time.monotonic() - began < 5 * READER_TIMEOUT:
                time.sleep(pause)
    return received


def test_answers_that_nobody_reads_end_their_connection(port, size):
    with ask(port) as connection:
        time.sleep(3 * READER_TIMEOUT)
        assert read(connection) < COUNT * size


def test_answers_that_are_read_slowly_come_whole(port, size):
    with ask(port) as connection:
        assert read(connection, pause=READER_TIMEOUT / 8) > COUNT * size


@pytest.mark.slow
async def test_a_watcher_that_does_not_read_leaves_its_place_to_another():
    large = make_sheet(40, 0.01)
    options = pb.ResultOptions(include_covariance=True, vertex_encoding=pb.ARRAY_ENCODING_FLOAT64)
    small_window = [("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", 1 << 16)]
    async with serving(reader_timeout=READER_TIMEOUT, max_watchers=1) as addresses:
        direct, deaf = grpc.aio.insecure_channel(addresses.grpc), grpc.aio.insecure_channel(addresses.grpc, small_window)
        async with direct, deaf:
            stub = TrackingServiceStub(direct)
            creation = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment=pack_mesh(*large)))
            name = (await stub.CreateSession(creation, timeout=TIMEOUT)).name
            watch = pb.WatchSessionRequest(name=name, api_version=API_VERSION)
            unread = TrackingServiceStub(deaf).WatchSession(watch)
            assert (await unread.read()).HasField("started")

            async def watched() -> bool:
                call = stub.WatchSession(watch)
                try:
                    return (await call.read()).HasField("started")
                except grpc.RpcError as error:
                    return not isinstance(from_rpc_error(error), ResourceExhausted)
                finally:
                    call.cancel()

            assert not await watched()
            lossless = pb.FLOW_MODE_LOSSLESS
            begin = pb.Start(name=name, api_version=API_VERSION, flow_mode=lossless, result_options=options)
            start = pb.TrackRequest(start=begin)
            requests = [start, *(request_of(frame_of(large, number)) for number in range(1, 61))]
            assert len([answer async for answer in stub.Track(iter(requests), timeout=TIMEOUT)]) == 61
            async for _ in stub.Track(iter([start]), timeout=TIMEOUT):  # its client had READER_TIMEOUT meanwhile
                pass
            assert await watched()
            unread.cancel()

"""WebSocket clients for the tests: one for messages of the contract, one plain socket."""

from __future__ import annotations

import contextlib
import socket

import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf import json_format
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from ..conftest import TIMEOUT

START = pb.TrackRequest(start=pb.Start(api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS))


class Line:
    """A WebSocket in one of the two modes that sends and receives messages of the contract."""

    def __init__(self, connection, mode: str):
        self.connection, self._json = connection, mode == "json"

    def send(self, request: pb.TrackRequest | None) -> None:
        if self._json:
            self.connection.send(json_format.MessageToJson(request) if request else "{}")
        else:
            self.connection.send(request.SerializeToString() if request else b"")

    def receive(self) -> pb.TrackResponse:
        message = self.connection.recv(timeout=TIMEOUT)
        assert isinstance(message, str) == self._json
        if self._json:
            return json_format.Parse(message, pb.TrackResponse())
        return pb.TrackResponse.FromString(message)

    def track(self, requests) -> list[pb.TrackResponse]:
        """All the responses to a start, some requests, and the empty message."""
        for request in (START, *requests, None):
            self.send(request)
        responses = []
        with contextlib.suppress(ConnectionClosed):
            while True:
                responses.append(self.receive())
        return responses

    def ending(self) -> tuple[int, str]:
        """Close code and reason; earlier messages are skipped."""
        with pytest.raises(ConnectionClosed) as caught:  # noqa: PT012
            while True:
                self.connection.recv(timeout=TIMEOUT)
        return caught.value.rcvd.code, caught.value.rcvd.reason


@contextlib.contextmanager
def line(service, path: str, mode: str = "binary", **options):
    url = f"{service.http.replace('http', 'ws', 1)}/v1/{path}"
    url += ("&" if "?" in path else "?") + f"mode={mode}"
    with connect(url, max_size=None, proxy=None, open_timeout=TIMEOUT, **options) as connection:
        yield Line(connection, mode)


def handshake(service, path: str) -> socket.socket:
    """A client that can leave pings unanswered and has small receive buffers."""
    url = httpx.URL(service.http)
    connection = socket.socket()
    connection.settimeout(TIMEOUT)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 12)
    connection.connect((url.host, url.port))
    head = f"GET /v1/{path} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    connection.sendall(f"{head}Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
    assert b" 101 " in connection.recv(1 << 10)
    return connection

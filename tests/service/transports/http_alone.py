"""A service's HTTP port without workers, in this process, for tests of requests that reach no tracker."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from typing import NamedTuple

from ddakf_service.server import Server
from ddakf_service.settings import Settings

from ..conftest import TIMEOUT


class Answer(NamedTuple):
    """A raw response."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def error(self) -> dict:
        return json.loads(self.body)["error"]


class Port(NamedTuple):
    """The listening port."""

    number: int

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.number}"

    def send(self, request: str | bytes, *, until_closed: bool = True) -> Answer:
        """The answer to raw bytes; ``{host}`` in a text is this port's name.

        Args:
            until_closed: the server has to close the connection; otherwise it has to keep it, and a second request is answered.
        """
        data = request.replace("{host}", f"127.0.0.1:{self.number}").encode() if isinstance(request, str) else request
        with socket.create_connection(("127.0.0.1", self.number), timeout=TIMEOUT) as connection:
            connection.sendall(data)
            if until_closed:
                return _parsed(b"".join(iter(lambda: connection.recv(1 << 16), b"")))
            reader = connection.makefile("rb")
            first = _read(reader, head=data.startswith(b"HEAD"))
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert _read(reader).status == 200, "the connection is in step"
            return first


@contextlib.contextmanager
def http_alone(**settings) -> Iterator[Port]:
    """The HTTP port of a service whose workers are not started."""
    started, stopping = threading.Event(), asyncio.Event()
    found: list = []

    async def serve() -> None:
        server = Server(Settings(**{"data_dir": "none", "grpc_port": 0, "http_port": 0, "workers": 1, **settings}))
        await server._load_keys()
        await server._sessions.load()
        found.extend((await server._http.start(), asyncio.get_running_loop(), server))
        started.set()
        await stopping.wait()
        await server._shut_down()

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    try:
        assert started.wait(TIMEOUT)
        yield Port(found[0])
    finally:
        found[1].call_soon_threadsafe(stopping.set)
        thread.join(TIMEOUT)


def _parsed(data: bytes) -> Answer:
    head, _, body = data.partition(b"\r\n\r\n")
    status, *lines = head.decode("latin-1").split("\r\n")
    headers = dict(line.split(": ", 1) for line in lines)
    return Answer(int(status.split()[1]), {name.lower(): value for name, value in headers.items()}, body)


def _read(reader, head: bool = False) -> Answer:
    """One response of a connection that stays open."""
    lines = b"".join(iter(reader.readline, b"\r\n")) + b"\r\n"
    answer = _parsed(lines)
    return answer if head else answer._replace(body=reader.read(int(answer.headers["content-length"])))

"""Wire format between the server and a worker process: kind, request number, session id, content."""

from __future__ import annotations

import asyncio
import enum
import socket
import struct
from typing import NamedTuple

_HEADER = struct.Struct("<BIHQ")  # kind, request number, bytes of the session id, bytes of the content
_FRAME = struct.Struct("<II")  # points that the frame may have, bytes of the options
_RESULT = struct.Struct("<I")  # bytes of the numbers


class Kind(enum.IntEnum):
    """Kind of a request (below 16) or of an answer."""

    OPEN = 1
    RESTORE = 2
    FRAME = 3
    RESET = 4
    SNAPSHOT = 5
    CLOSE = 6
    CONFIGURE = 7

    RESULT = 16
    ERROR = 17
    PROGRESS = 18
    READY = 19


class Message(NamedTuple):
    kind: Kind
    number: int = 0
    session_id: str = ""
    content: bytes = b""

    def head(self) -> bytes:
        """The bytes before the content."""
        return head(self.kind, self.number, self.session_id, len(self.content))


def head(kind: Kind, number: int, session_id: str, content_size: int) -> bytes:
    """The bytes of a message before its content."""
    name = session_id.encode()
    return _HEADER.pack(kind, number, len(name), content_size) + name


def frame_request_head(options: bytes, max_points: int) -> bytes:
    """Content of a FRAME request before the serialised Frame: ResultOptions, and the session's bound on points."""
    return _FRAME.pack(max_points, len(options)) + options


def unpack_frame_request(content: bytes) -> tuple[bytes, memoryview, int]:
    """Serialised ResultOptions, serialised Frame and bound on points of a FRAME request."""
    max_points, size = _FRAME.unpack_from(content)
    end = _FRAME.size + size
    return content[_FRAME.size : end], memoryview(content)[end:], max_points


def pack_result(numbers: bytes, arrays: bytes) -> bytes:
    """Content of the answer to a FRAME request: the serialised Result without arrays, and with its arrays alone."""
    return b"".join((_RESULT.pack(len(numbers)), numbers, arrays))


def unpack_result(content: bytes) -> tuple[bytes, memoryview]:
    """The inverse of :func:`pack_result`."""
    (size,) = _RESULT.unpack_from(content)
    end = _RESULT.size + size
    return content[_RESULT.size : end], memoryview(content)[end:]


async def read(reader: asyncio.StreamReader) -> Message:
    """The next message; asyncio.IncompleteReadError at the end of the stream."""
    kind, number, id_size, size = _HEADER.unpack(await reader.readexactly(_HEADER.size))
    session_id = (await reader.readexactly(id_size)).decode()
    return Message(Kind(kind), number, session_id, await reader.readexactly(size))


class BlockingChannel:
    """The worker's end of the pipe: blocking reads and writes, one request at a time."""

    def __init__(self, connection: socket.socket):
        self._connection = connection
        self._file = connection.makefile("rb", buffering=1 << 20)

    def receive(self) -> Message | None:
        """The next message; None when the server is gone."""
        head = self._file.read(_HEADER.size)
        if len(head) < _HEADER.size:
            return None
        kind, number, id_size, size = _HEADER.unpack(head)
        session_id = self._file.read(id_size).decode()
        content = self._file.read(size)
        return Message(Kind(kind), number, session_id, content) if len(content) == size else None

    def send(self, message: Message) -> None:
        # One write, so that the event loop at the other end wakes once.
        self._connection.sendall(message.head() + message.content)

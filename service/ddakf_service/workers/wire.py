"""Messages between the server and a worker process: kind, request number, session id, payload."""

from __future__ import annotations

import asyncio
import enum
import socket
import struct
from typing import NamedTuple

_HEADER = struct.Struct("<BIHQ")  # kind, request number, bytes of the session id, bytes of the payload
_FRAME = struct.Struct("<II")  # points that the frame may have, bytes of the options


class Kind(enum.IntEnum):
    """What a message asks for, or what it answers."""

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
    payload: bytes = b""

    def head(self) -> bytes:
        """All that goes before the payload."""
        session_id = self.session_id.encode()
        return _HEADER.pack(self.kind, self.number, len(session_id), len(self.payload)) + session_id


def join(options: bytes, frame: bytes, max_points: int) -> bytes:
    """The payload of a FRAME: serialised ResultOptions and Frame, and how many points the session lets it have."""
    return b"".join((_FRAME.pack(max_points, len(options)), options, frame))


def split(payload: bytes) -> tuple[bytes, bytes, int]:
    """The inverse of :func:`join`."""
    max_points, size = _FRAME.unpack_from(payload)
    end = _FRAME.size + size
    return payload[_FRAME.size : end], payload[end:], max_points


async def read(reader: asyncio.StreamReader) -> Message:
    """The next message; asyncio.IncompleteReadError at the end of the stream."""
    kind, number, id_size, size = _HEADER.unpack(await reader.readexactly(_HEADER.size))
    session_id = (await reader.readexactly(id_size)).decode()
    return Message(Kind(kind), number, session_id, await reader.readexactly(size))


class BlockingChannel:
    """The worker's end: plain blocking reads and writes, for it does one thing at a time."""

    def __init__(self, connection: socket.socket):
        self._connection = connection
        self._file = connection.makefile("rb", buffering=1 << 20)

    def receive(self) -> Message | None:
        """The next message, or None when the server is gone."""
        head = self._file.read(_HEADER.size)
        if len(head) < _HEADER.size:
            return None
        kind, number, id_size, size = _HEADER.unpack(head)
        session_id = self._file.read(id_size).decode()
        payload = self._file.read(size)
        return Message(Kind(kind), number, session_id, payload) if len(payload) == size else None

    def send(self, message: Message) -> None:
        # In one piece: the event loop at the other end is woken once.
        self._connection.sendall(message.head() + message.payload)

"""Wire format between the server and a worker process: kind, request number, session id, content."""

from __future__ import annotations

import asyncio
import enum
import socket
import struct
from typing import NamedTuple

_HEADER = struct.Struct("<BQHQ")  # kind, request number, bytes of the session id, bytes of the content
_FRAME = struct.Struct("<Id?I")  # points that the frame may have, its grant, bytes of the options
_RESULT = struct.Struct("<Idddd??")  # bytes of the numbers, what the frame took
_ERROR = struct.Struct("<dd")  # processor and busy seconds, as in Spent


class Kind(enum.IntEnum):
    """Kind of a request (below 16) or of an answer."""

    OPEN = 1
    RESTORE = 2
    FRAME = 3
    RESET = 4
    SNAPSHOT = 5
    CLOSE = 6
    CONFIGURE = 7
    HEAVY_FRAME = 8  # a frame of a session whose last frames exceeded their slice, see :mod:`.lanes`
    IMPORT = 9  # a RESTORE of a snapshot that a client sent

    RESULT = 16
    ERROR = 17
    READY = 19
    ASIDE = 20  # a request goes on beside the next one; its answer comes later


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


class Grant(NamedTuple):
    """What a frame may take of its worker.

    Attributes:
        budget: processor seconds to plan with; 0: none.
        lighter: the session's lighter tracker is to track it, if there is one.
    """

    budget: float = 0.0
    lighter: bool = False


WHOLE = Grant()  # its own tracker, without a budget


class FrameRequest(NamedTuple):
    """Content of a FRAME request.

    Attributes:
        options: serialised ResultOptions.
        frame: serialised Frame.
        max_points: the session's bound on points.
        grant: what it may take.
    """

    options: bytes
    frame: memoryview
    max_points: int
    grant: Grant = WHOLE


class Spent(NamedTuple):
    """What a frame took in its worker.

    Attributes:
        processor: seconds of its thread, and of the decoder process for it.
        prediction: seconds of these, for the prediction and a search.
        busy: seconds since the worker's last answer in which it tracked this frame or others.
        widening: factor for what the budget left out; 1: nothing.
        lighter: the session's lighter tracker has tracked it.
        has_lighter: the session has such a tracker, or may get one when it is wanted.
    """

    processor: float = 0.0
    prediction: float = 0.0
    busy: float = 0.0
    widening: float = 1.0
    lighter: bool = False
    has_lighter: bool = True


def frame_request_head(options: bytes, max_points: int, grant: Grant = WHOLE) -> bytes:
    """Content of a FRAME request before the serialised Frame."""
    return _FRAME.pack(max_points, *grant, len(options)) + options


def unpack_frame_request(content: bytes) -> FrameRequest:
    """The FRAME request with this content."""
    max_points, *grant, size = _FRAME.unpack_from(content)
    end = _FRAME.size + size
    return FrameRequest(content[_FRAME.size : end], memoryview(content)[end:], max_points, Grant(*grant))


def pack_result(numbers: bytes, arrays: bytes, spent: Spent) -> bytes:
    """Content of the answer to a FRAME request: the serialised Result without arrays, and with its arrays alone."""
    return b"".join((_RESULT.pack(len(numbers), *spent), numbers, arrays))


def unpack_result(content: bytes) -> tuple[bytes, memoryview]:
    """The two parts of a Result."""
    size = _RESULT.unpack_from(content)[0]
    end = _RESULT.size + size
    return content[_RESULT.size : end], memoryview(content)[end:]


def unpack_spent(content: bytes) -> Spent:
    """What the frame of a result took."""
    return Spent(*_RESULT.unpack_from(content)[1:])


def pack_error(detail: bytes, processor: float, busy: float) -> bytes:
    """Content of an ERROR: a serialised ErrorDetail, after what the request took; see :class:`Spent`."""
    return _ERROR.pack(processor, busy) + detail


def unpack_error(content: bytes) -> tuple[bytes, Spent]:
    """The serialised ErrorDetail, and what the request took."""
    processor, busy = _ERROR.unpack_from(content)
    return content[_ERROR.size :], Spent(processor, busy=busy)


async def read(reader: asyncio.StreamReader) -> Message:
    """The next message; asyncio.IncompleteReadError at the end of the stream."""
    kind, number, id_size, size = _HEADER.unpack(await reader.readexactly(_HEADER.size))
    session_id = (await reader.readexactly(id_size)).decode()
    return Message(Kind(kind), number, session_id, await reader.readexactly(size))


class BlockingChannel:
    """The worker's end of the pipe: blocking reads and writes, each by one thread at a time."""

    def __init__(self, connection: socket.socket):
        self._connection = connection
        self._file = connection.makefile("rb", buffering=1 << 20)

    def receive(self) -> Message | None:
        """The next message; None when the server is gone."""
        try:
            head = self._file.read(_HEADER.size)
            if len(head) < _HEADER.size:
                return None
            kind, number, id_size, size = _HEADER.unpack(head)
            session_id = self._file.read(id_size).decode()
            content = self._file.read(size)
        except ConnectionError:  # it closed with an answer unread
            return None
        return Message(Kind(kind), number, session_id, content) if len(content) == size else None

    def send(self, message: Message) -> None:
        # One write, so that the event loop at the other end wakes once.
        self._connection.sendall(message.head() + message.content)

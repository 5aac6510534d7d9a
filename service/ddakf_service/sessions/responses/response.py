"""Responses: messages to the client of a stream, with the arrays of a result as the worker serialised them."""

from __future__ import annotations

from typing import NamedTuple

from ddakf_api.v1 import tracking_pb2 as pb

_RESULT_TAG, _FRAME_TAG = b"\x12", b"\x3a"  # of a TrackResponse


class Response(NamedTuple):
    """A TrackResponse.

    Attributes:
        message: the response; a result has no arrays.
        arrays: the serialised Result with the arrays alone, which follows that of the message. Empty: none.
        frame: the serialised Frame as it arrived, for a watcher; the message is empty then.
    """

    message: pb.TrackResponse
    arrays: bytes | memoryview = b""
    frame: bytes | memoryview = b""

    @classmethod
    def of_result(cls, numbers: bytes, arrays: bytes | memoryview) -> Response:
        """The response of a worker's Result in two parts, see :meth:`.workers.pool.WorkerPool.submit`."""
        message = pb.TrackResponse()
        message.result.ParseFromString(numbers)
        return cls(message, arrays)

    @classmethod
    def of_frame(cls, frame: bytes | memoryview) -> Response:
        """The frame of the next result, for a watcher."""
        return cls(pb.TrackResponse(), frame=frame)

    @property
    def sequence_number(self) -> int:
        """Of the frame that this is the answer to; 0: of none."""
        kind = self.message.WhichOneof("message")
        return getattr(self.message, kind).sequence_number if kind in ("result", "frame_error") else 0

    def has(self, field: str) -> bool:
        """Whether the response is of this kind."""
        return self.message.HasField(field)

    def without_arrays(self) -> Response:
        """The response with the numbers of its result alone."""
        return Response(self.message)

    def serialised(self) -> bytes:
        """The serialised TrackResponse."""
        if self.frame:
            return b"".join((_FRAME_TAG, _varint(len(self.frame)), self.frame))
        if not self.arrays:
            return self.message.SerializeToString()
        numbers = self.message.result.SerializeToString()
        return b"".join((_RESULT_TAG, _varint(len(numbers) + len(self.arrays)), numbers, self.arrays))

    def whole_message(self) -> pb.TrackResponse:
        """The response with its arrays as a message."""
        return pb.TrackResponse.FromString(self.serialised()) if self.arrays or self.frame else self.message


def _varint(value: int) -> bytes:
    """A number of variable length."""
    data = bytearray()
    while value > 0x7F:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    data.append(value)
    return bytes(data)

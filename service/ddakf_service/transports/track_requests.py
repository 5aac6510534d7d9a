"""Track requests: serialised requests of a stream as frames, or as messages of the other kinds."""

from __future__ import annotations

from ddakf_api.v1 import tracking_pb2 as pb

from ..streaming.frame_message import SMALL, FrameMessage, TrackRequest
from ..streaming.frame_reader import frame_bytes, read_frame
from .bounded_parsing import parse


def read_track_request(data: bytes) -> TrackRequest:
    """Reads a serialised TrackRequest. A parse of up to :data:`SMALL` bytes takes less time than the frame reader.

    Raises:
        MessageTooLarge, DecodeError: see :func:`.bounded_parsing.parse`.
    """
    if len(data) > SMALL and (frame := read_frame(data)) is not None:
        return frame
    return without_frame(parse(pb.TrackRequest, data), data)


def without_frame(request: pb.TrackRequest, data: bytes | None = None) -> TrackRequest:
    """The frame of a request that has one, otherwise the request.

    Args:
        data: the bytes that the request was parsed from, if it was.
    """
    if request.WhichOneof("message") != "frame":
        return request
    return FrameMessage.of(request.frame, None if data is None else frame_bytes(data))

"""Incoming frames: the serialised message for the worker, and the fields that the network process needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from ddakf_api.v1 import tracking_pb2 as pb

SMALL = 1 << 16
"""Bytes of a message whose fields are within every limit on their size, see :mod:`.frame_bounds`."""

LARGE_FIELDS = {"point_cloud": ("data", "colors"), "depth_image": ("data", "mask", "confidence", "colors")}


class FrameMessage(NamedTuple):
    """A frame as it arrived.

    Attributes:
        data: the serialised Frame, which the worker parses.
        sequence_number, capture_time, deadline: as in the message.
        sensor_count: number of sensors.
        measurement: "point_cloud", "depth_image" or None: the field that is set.
        codec: PointCodec of the cloud, or DepthCompression of the image.
        point_count: of the cloud.
        width, height: of the image, pixels.
        sizes: bytes by name of :data:`LARGE_FIELDS`; empty for a message of at most :data:`SMALL` bytes.
    """

    data: bytes | memoryview
    sequence_number: int = 0
    capture_time: float = 0.0
    deadline: float = 0.0
    sensor_count: int = 0
    measurement: str | None = None
    codec: int = 0
    point_count: int = 0
    width: int = 0
    height: int = 0
    sizes: Mapping[str, int] = {}

    @classmethod
    def of(cls, frame: pb.Frame, data: bytes | memoryview | None = None) -> FrameMessage:
        """Reads a parsed frame.

        Args:
            data: the bytes that it was parsed from; None: they are made.
        """
        data = frame.SerializeToString() if data is None else data
        measurement = frame.WhichOneof("payload")
        fields = getattr(frame, measurement) if measurement else None
        is_image = measurement == "depth_image"
        return cls(
            data,
            frame.sequence_number,
            frame.capture_time,
            frame.deadline,
            len(frame.sensors),
            measurement,
            0 if fields is None else fields.compression if is_image else fields.codec,
            0 if fields is None or is_image else fields.point_count,
            fields.width if is_image else 0,
            fields.height if is_image else 0,
            # The length of a field costs a copy of it.
            {name: len(getattr(fields, name)) for name in LARGE_FIELDS.get(measurement, ())} if len(data) > SMALL else {},
        )


TrackRequest = pb.TrackRequest | FrameMessage
"""A request of a stream: a frame as it arrived, or a message of another kind."""

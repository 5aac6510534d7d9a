"""What a frame may weigh: refused at the door, before a worker sees it, is what would only take memory while it waits."""

from __future__ import annotations

from ddakf_api.codec import require_few_sensors, require_image_within
from ddakf_api.errors import InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb

# A point of the least compact codec takes 12 bytes; smaller clouds carry headers.
_BYTES_PER_POINT, _HEADER_BYTES = 12, 1 << 16


def require_payload_within(frame: pb.Frame, max_points: int, max_pixels: int) -> None:
    """Raises :class:`InvalidFrame` for a payload that no frame within the limits has; nothing is decoded."""
    require_few_sensors(frame.sensors)
    if frame.WhichOneof("payload") == "depth_image":
        require_image_within(frame.depth_image, max_pixels)
        return
    cloud, most = frame.point_cloud, max_points * _BYTES_PER_POINT + _HEADER_BYTES
    if cloud.point_count > max_points:
        raise InvalidFrame(field="point_cloud.point_count", expected=f"at most {max_points}", got=str(cloud.point_count))
    if len(cloud.data) > most:
        raise InvalidFrame(
            field="point_cloud.data", expected=f"bytes of at most {max_points} points", got=f"{len(cloud.data)} bytes"
        )

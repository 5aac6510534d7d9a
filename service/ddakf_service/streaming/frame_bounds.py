"""Frame bounds: size checks of a frame before it waits for a worker; nothing is decoded."""

from __future__ import annotations

from ddakf_api.codec import require_few_sensors, require_image_within
from ddakf_api.errors import InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb

# The least compact codec takes 12 bytes a point; small clouds consist mostly of headers.
_BYTES_PER_POINT, _HEADER_BYTES = 12, 1 << 16


def require_frame_within_bounds(frame: pb.Frame, max_points: int, max_pixels: int) -> None:
    """Rejects a measurement that is larger than any frame within the limits.

    Raises:
        InvalidFrame: names the field.
    """
    require_few_sensors(frame.sensors)
    if frame.WhichOneof("payload") == "depth_image":
        require_image_within(frame.depth_image, max_pixels)
        return
    cloud, max_bytes = frame.point_cloud, max_points * _BYTES_PER_POINT + _HEADER_BYTES
    if cloud.point_count > max_points:
        raise InvalidFrame(field="point_cloud.point_count", expected=f"at most {max_points}", got=str(cloud.point_count))
    if len(cloud.data) > max_bytes:
        raise InvalidFrame(
            field="point_cloud.data", expected=f"bytes of at most {max_points} points", got=f"{len(cloud.data)} bytes"
        )

"""Frame bounds: size checks of a frame before it waits for a worker; nothing is decoded."""

from __future__ import annotations

from ddakf_api.codec import require_image_size_within, require_sensor_count
from ddakf_api.errors import InvalidFrame

from .frame_message import FrameMessage

# The least compact codec takes 12 bytes a point; small clouds consist mostly of headers.
_BYTES_PER_POINT, _HEADER_BYTES = 12, 1 << 16


def require_frame_within_bounds(frame: FrameMessage, max_points: int, max_pixels: int) -> None:
    """Rejects a measurement that is larger than any frame within the limits.

    Raises:
        InvalidFrame: names the field.
    """
    require_sensor_count(frame.sensor_count)
    if frame.measurement == "depth_image":
        require_image_size_within(frame.width, frame.height, frame.sizes, max_pixels)
        return
    if frame.point_count > max_points:
        raise InvalidFrame(field="point_cloud.point_count", expected=f"at most {max_points}", got=str(frame.point_count))
    max_bytes = max_points * _BYTES_PER_POINT + _HEADER_BYTES
    if (size := frame.sizes.get("data", 0)) > max_bytes:
        raise InvalidFrame(field="point_cloud.data", expected=f"bytes of at most {max_points} points", got=f"{size} bytes")

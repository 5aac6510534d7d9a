"""Frame bounds: size checks of a frame before it waits for a worker; nothing is decoded."""

from __future__ import annotations

from ddakf_api.codec import require_image_size_within, require_sensor_count
from ddakf_api.errors import InvalidFrame

from .frame_message import FrameMessage

# The least compact codec takes 12 bytes a point; small clouds consist mostly of headers.
_BYTES_PER_POINT, _HEADER_BYTES = 12, 1 << 16
_BODY = 12  # bytes of a vertex


def require_frame_within_bounds(frame: FrameMessage, max_points: int, max_pixels: int, max_body_vertices: int) -> None:
    """Rejects a frame without a measurement, or one that is larger than any frame within the limits.

    Raises:
        InvalidFrame: names the field.
    """
    require_sensor_count(frame.sensor_count)
    most = _BODY * max_body_vertices + _HEADER_BYTES
    if frame.sizes and (rest := len(frame.data) - sum(frame.sizes.values())) > most:
        expected = f"at most {most} bytes beside the measurement, of {max_body_vertices} body_vertices"
        raise InvalidFrame(field="frame", expected=expected, got=f"{rest} bytes")
    if frame.measurement is None:
        expected = "a point_cloud (an empty one has no points) or a depth_image"
        raise InvalidFrame(field="payload", expected=expected, got="neither")
    if frame.measurement == "depth_image":
        require_image_size_within(frame.width, frame.height, frame.sizes, max_pixels)
        return
    if frame.point_count > max_points:
        raise InvalidFrame(field="point_cloud.point_count", expected=f"at most {max_points}", got=str(frame.point_count))
    for name, per_point, headers in (("data", _BYTES_PER_POINT, _HEADER_BYTES), ("colors", 3, 0)):
        if (size := frame.sizes.get(name, 0)) > max_points * per_point + headers:
            expected = f"bytes of at most {max_points} points"
            raise InvalidFrame(field=f"point_cloud.{name}", expected=expected, got=f"{size} bytes")

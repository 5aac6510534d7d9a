"""Fields of a frame by the arguments of the tracker that come from them, for errors and warnings."""

from __future__ import annotations

from ddakf_api.v1 import tracking_pb2 as pb

_FIELDS = {"points": "point_cloud", "timestamp": "capture_time", "sensor_origin": "sensors", "colors": "point_cloud.colors"}
_IMAGE_FIELDS = {"points": "depth_image", "sensor_origin": "depth_image.pose", "colors": "depth_image.colors"}


def field_of_frame(argument: str, frame: pb.Frame) -> str:
    """Field of the frame that an argument of ``Tracker.step`` comes from; other names stay as they are."""
    fields = _FIELDS | _IMAGE_FIELDS if frame.WhichOneof("payload") == "depth_image" else _FIELDS
    return fields.get(argument, argument)

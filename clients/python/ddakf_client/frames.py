"""Frames: objects of the caller to ``Frame`` messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from ddakf_api.arrays import checked_array
from ddakf_api.codec import DEFAULT_DEPTH_CODEC, DEFAULT_SCALE, encode, encode_depth, group_by_sensor
from ddakf_api.codec.colors import checked_colors
from ddakf_api.codec.depth import checked_scale
from ddakf_api.errors import CodecError, InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb

_ARRAYS = ("points", "sensor_origin", "body_vertices", "depth", "intrinsics", "pose", "mask", "confidence", "colors")
_OF_IMAGES = ("mask", "confidence", "pose", "intrinsics")
_IMAGE_OPTIONS = ("pose", "mask", "confidence", "min_confidence", "colors", "depth_scale")


@dataclass(frozen=True, eq=False)
class Frame:
    """Measurements at one time: points, or the depth image of one camera.

    Attributes:
        points: (N, 3) metres, world frame; N may be 0. None for a depth image.
        timestamp: seconds of the caller's clock, strictly increasing.
        sensor_origin: optical centre in metres: (3,) for one sensor, (N, 3) one per point for several sensors; None: unknown,
            estimated where the cloud shows one side.
        body_vertices: (B, 3) metres, the body in this frame; None: unknown.
        depth: (H, W) along the optical axis, 0 or NaN for none: floats in metres, or uint16 in units of `depth_scale`.
        intrinsics: fx, fy, cx, cy, pixels; pixel (0, 0) is the centre of the top left one.
        pose: (3, 4) or (4, 4) [R | t], camera axes (x right, y down, z forward) to world; None: the identity.
        mask: (H, W), zero outside the garment; None: all pixels are of the garment.
        confidence: (H, W) uint8, 255 is the highest, 0 unusable; None: unknown.
        min_confidence: pixels of lower confidence are ignored.
        colors: uint8 red, green, blue of the points (N, 3), or of what the pixels of the depth see (H, W, 3); None: unknown.
        depth_scale: metres per unit of uint16 depth, at most 1: 0.001 for millimetres.
        display_time: time of display, seconds of the caller's clock, at most 0.5 s after `timestamp`; the result is predicted to
            this time. None: the time of capture.
        deadline: seconds after the arrival at the server within which tracking has to begin. A later frame is refused
            (DeadlineExceeded; see `on_error`) and counted as late. None: no deadline.
    """

    points: np.ndarray | None = None
    timestamp: float | None = None
    sensor_origin: np.ndarray | None = None
    body_vertices: np.ndarray | None = None
    depth: np.ndarray | None = None
    intrinsics: Sequence[float] | None = None
    pose: np.ndarray | None = None
    mask: np.ndarray | None = None
    confidence: np.ndarray | None = None
    min_confidence: int = 0
    depth_scale: float = DEFAULT_SCALE
    display_time: float | None = None
    deadline: float | None = None
    colors: np.ndarray | None = None

    @classmethod
    def of(cls, frame: object) -> Frame:
        """Converts a frame, a tuple of its first two to four fields, or an object with (some of) its attributes.

        Raises:
            InvalidFrame: another object.
        """
        if isinstance(frame, cls):
            return frame
        if isinstance(frame, tuple) and 2 <= len(frame) <= 4:
            return cls(*frame)
        if hasattr(frame, "timestamp") and (hasattr(frame, "points") or hasattr(frame, "depth")):
            names = (field.name for field in fields(cls))
            return cls(**{name: getattr(frame, name) for name in names if hasattr(frame, name)})
        expected = "a Frame, a tuple (points, timestamp[, sensor_origin[, body_vertices]]) or an object with these"
        got = f"a tuple of {len(frame)}" if isinstance(frame, tuple) else type(frame).__name__
        raise InvalidFrame(field="frame", expected=expected, got=got)


def held(frame: object) -> object:
    """The frame with its own arrays: a camera writes the next one into the same buffer, before this one is sent or sent again.

    What is no frame stays as it is, and is refused when it is to be sent.
    """
    try:
        given = Frame.of(frame)
    except Exception:  # of the caller's object too
        return frame
    return replace(given, **{name: _copied(getattr(given, name)) for name in _ARRAYS})


def _copied(value: object) -> object:
    """A copy as an array; what cannot be one stays as it is."""
    try:
        array = value if isinstance(value, np.ndarray) else np.asarray(value)
        return array.copy() if array.ndim else value
    except Exception:  # of NumPy or of the object's own conversion
        return value


def time_of(frame: object) -> float | None:
    """The seconds of a frame that may be why it is refused; None: it has none."""
    try:
        return _seconds("timestamp", frame[1] if isinstance(frame, tuple) else frame.timestamp)
    except Exception:  # of the caller's object too
        return None


def to_message(frame: Frame, sequence: int, codec: str, step: float, depth_codec: str = DEFAULT_DEPTH_CODEC) -> pb.Frame:
    """The message of a frame.

    Raises:
        InvalidFrame: an invalid field; :class:`~ddakf_api.errors.CodecError` for points or images.
    """
    message = pb.Frame(sequence_number=sequence, capture_time=_seconds("timestamp", frame.timestamp))
    if frame.display_time is not None:
        message.display_time = _seconds("display_time", frame.display_time)
    if frame.deadline is not None:
        message.deadline = _seconds("deadline", frame.deadline)
        if message.deadline <= 0:
            raise InvalidFrame(field="deadline", expected="seconds above 0", got=repr(frame.deadline))
    if frame.body_vertices is not None:
        message.body_vertices = _body(frame.body_vertices).tobytes()
    if frame.depth is None:
        _add_points(message, frame, codec, step)
    else:
        _add_depth(message, frame, depth_codec)
    return message


def _add_points(message: pb.Frame, frame: Frame, codec: str, step: float) -> None:
    points, runs = _points(frame.points), None
    _require_none(frame, _OF_IMAGES, "points")
    colors = None if frame.colors is None or len(points) == 0 else checked_colors(frame.colors, points.shape)
    if frame.sensor_origin is not None:
        points, runs, order = _with_sensors(message, points, frame.sensor_origin)
        colors = colors if colors is None or order is None else colors[order]
    message.point_cloud.CopyFrom(encode(points, codec, step=step, runs=runs, colors=colors).cloud)


def _require_none(frame: Frame, names: Sequence[str], beside: str) -> None:
    for name in names:
        if getattr(frame, name) is not None:
            raise InvalidFrame(field=name, expected=f"none beside {beside}", got=type(getattr(frame, name)).__name__)


def _points(points: object) -> np.ndarray:
    expected = "numbers of shape (N, 3)"
    array = checked_array("points", points, expected=expected, columns=None, error=CodecError)
    if array.size == 0:  # an empty list has no second axis; it is a frame without measurements, as for the library
        return np.empty((0, 3))
    return checked_array("points", array, expected=expected, error=CodecError)


def _add_depth(message: pb.Frame, frame: Frame, codec: str) -> None:
    _require_none(frame, ("points", "sensor_origin"), "a depth image")
    checked_scale(frame.depth_scale, "depth_scale")
    image = encode_depth(
        frame.depth, frame.intrinsics, codec=codec, **{name: getattr(frame, name) for name in _IMAGE_OPTIONS}
    )
    message.depth_image.CopyFrom(image)


def _with_sensors(
    message: pb.Frame, points: np.ndarray, origin: object
) -> tuple[np.ndarray, list[int] | None, np.ndarray | None]:
    """Adds the sensors to the message; returns the points in runs by sensor, the lengths of the runs, and the order in them."""
    expected = "finite numbers of shape (3,) or (N, 3)"
    origin = checked_array("sensor_origin", origin, expected=expected, columns=None, error=InvalidFrame)
    per_point = origin.ndim == 2 and origin.shape == points.shape
    if not (origin.shape == (3,) or per_point) or not np.isfinite(origin).all():
        got = f"{origin.dtype} of shape {origin.shape}"
        raise InvalidFrame(field="sensor_origin", expected=expected, got=got)
    if not per_point:
        _add_sensor(message, origin)
        return points, None, None
    order, runs, origins = group_by_sensor(origin)
    for sensor_position, count in zip(origins, runs, strict=True):
        _add_sensor(message, sensor_position).point_count = count
    return points[order], runs, order


def _add_sensor(message: pb.Frame, origin: np.ndarray) -> pb.Sensor:
    x, y, z = origin.tolist()
    return message.sensors.add(origin=pb.Vector3(x=x, y=y, z=z))


def _seconds(field: str, time: float | None) -> float:
    try:
        seconds = float(time) if isinstance(time, (int, float, np.integer, np.floating)) else math.nan
    except OverflowError:
        seconds = math.inf
    if not math.isfinite(seconds):
        got = repr(time)[:40] if isinstance(time, (float, str, np.number)) else type(time).__name__
        raise InvalidFrame(field=field, expected="a finite number of seconds", got=got)
    return seconds


def _body(vertices: object) -> np.ndarray:
    vertices = checked_array("body_vertices", vertices, expected="numbers of shape (B, 3)", error=InvalidFrame)
    return vertices.astype("<f4", order="C")

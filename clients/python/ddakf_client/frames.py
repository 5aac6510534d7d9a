"""Frames of the caller as messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from ddakf_api.arrays import checked_array
from ddakf_api.codec import DEFAULT_DEPTH_CODEC, DEFAULT_SCALE, encode, encode_depth, group_by_sensor
from ddakf_api.errors import CodecError, InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb

_OF_THE_IMAGE = ("pose", "mask", "confidence", "min_confidence", "depth_scale")


@dataclass(frozen=True, eq=False)
class Frame:
    """What the sensors saw at one moment: points, or the depth image of one camera.

    Attributes:
        points: (N, 3) metres, world frame; N may be 0. None: there is a depth image.
        timestamp: seconds of the caller's clock, strictly increasing.
        sensor_origin: where the points were seen from, metres: (3,) for one sensor, (N, 3) one per point when several
            are fused; None: unknown, no visibility test.
        body_vertices: (B, 3) metres, the body in this frame; None: not known.
        depth: (H, W) along the optical axis, 0 or NaN for none: floats in metres, or uint16 in units of `depth_scale`.
        intrinsics: of the depth camera: fx, fy, cx, cy, pixels; pixel (0, 0) is the centre of the top left one.
        pose: (3, 4) or (4, 4) [R | t], camera axes (x right, y down, z forward) to world; None: the identity.
        mask: (H, W), zero where a pixel is not of the garment; None: all are.
        confidence: (H, W) uint8, 255 is certain, 0 unusable; None: not known.
        min_confidence: pixels of a lower one are left out.
        depth_scale: metres per unit of uint16 depth.
        display_time: when the garment will be shown, seconds of the caller's clock, at most half a second after `timestamp`: the
            result is predicted to it. None: as captured.
        deadline: seconds after its arrival at the server at which nobody needs an answer any more: a frame whose turn comes
            later is not tracked, but refused (DeadlineExceeded; see `on_error`) and counted as late. None: there is none.
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

    @classmethod
    def of(cls, frame: object) -> Frame:
        """A frame from a frame, a tuple of its first two to four fields, or any object with (some of) the attributes.

        Raises:
            InvalidFrame: neither of these.
        """
        if isinstance(frame, cls):
            return frame
        if isinstance(frame, tuple) and 2 <= len(frame) <= 4:
            return cls(*frame)
        if hasattr(frame, "timestamp") and (hasattr(frame, "points") or hasattr(frame, "depth")):
            names = (field.name for field in fields(cls))
            return cls(**{name: getattr(frame, name) for name in names if hasattr(frame, name)})
        expected = "a Frame, a tuple (points, timestamp[, sensor_origin[, body_vertices]]) or an object with these"
        raise InvalidFrame(field="frame", expected=expected, got=type(frame).__name__)


def to_message(frame: Frame, sequence: int, codec: str, step: float, depth_codec: str = DEFAULT_DEPTH_CODEC) -> pb.Frame:
    """The message of a frame.

    Raises:
        InvalidFrame: what cannot be sent; :class:`~ddakf_api.errors.CodecError` where it is about the points or the image.
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
    points, runs = checked_array("points", frame.points, expected="numbers of shape (N, 3)", error=CodecError), None
    if frame.sensor_origin is not None:
        points, runs = _with_sensors(message, points, frame.sensor_origin)
    message.point_cloud.CopyFrom(encode(points, codec, step=step, runs=runs).cloud)


def _add_depth(message: pb.Frame, frame: Frame, codec: str) -> None:
    for name in ("points", "sensor_origin"):
        if getattr(frame, name) is not None:
            raise InvalidFrame(field=name, expected="none beside a depth image", got=type(getattr(frame, name)).__name__)
    image = encode_depth(
        frame.depth, frame.intrinsics, codec=codec, **{name: getattr(frame, name) for name in _OF_THE_IMAGE}
    )
    message.depth_image.CopyFrom(image)


def _with_sensors(message: pb.Frame, points: np.ndarray, origin: object) -> tuple[np.ndarray, list[int] | None]:
    """Names the sensors in the message; returns the points in runs by sensor, and the runs' lengths."""
    expected = "finite numbers of shape (3,) or (N, 3)"
    origin = checked_array("sensor_origin", origin, expected=expected, columns=None, error=InvalidFrame)
    per_point = origin.ndim == 2 and origin.shape == points.shape
    if not (origin.shape == (3,) or per_point) or not np.isfinite(origin).all():
        got = f"{origin.dtype} of shape {origin.shape}"
        raise InvalidFrame(field="sensor_origin", expected=expected, got=got)
    if not per_point:
        _add_sensor(message, origin)
        return points, None
    order, runs, origins = group_by_sensor(origin)
    for place, count in zip(origins, runs, strict=True):
        _add_sensor(message, place).point_count = count
    return points[order], runs


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

"""Frames of the caller as messages."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from ddakf_api.arrays import checked_array
from ddakf_api.codec import encode, group_by_sensor
from ddakf_api.errors import CodecError, InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb


@dataclass(frozen=True, eq=False)
class Frame:
    """What the sensors saw at one moment.

    Attributes:
        points: (N, 3) metres, world frame; N may be 0.
        timestamp: seconds of the caller's clock, strictly increasing.
        sensor_origin: where the points were seen from, metres: (3,) for one sensor, (N, 3) one per point when several
            are fused; None: unknown, no visibility test.
        body_vertices: (B, 3) metres, the body in this frame; None: not known.
    """

    points: np.ndarray
    timestamp: float
    sensor_origin: np.ndarray | None = None
    body_vertices: np.ndarray | None = None

    @classmethod
    def of(cls, frame: object) -> Frame:
        """A frame from a frame, a tuple in the order of the fields, or any object with (some of) the attributes.

        Raises:
            InvalidFrame: neither of these.
        """
        if isinstance(frame, cls):
            return frame
        if isinstance(frame, tuple) and 2 <= len(frame) <= 4:
            return cls(*frame)
        if hasattr(frame, "points") and hasattr(frame, "timestamp"):
            optional = (getattr(frame, name, None) for name in ("sensor_origin", "body_vertices"))
            return cls(frame.points, frame.timestamp, *optional)
        expected = "a Frame, a tuple (points, timestamp[, sensor_origin[, body_vertices]]) or an object with these"
        raise InvalidFrame(field="frame", expected=expected, got=type(frame).__name__)


def to_message(frame: Frame, sequence: int, codec: str, step: float) -> pb.Frame:
    """The message of a frame.

    Raises:
        InvalidFrame: what cannot be sent; :class:`~ddakf_api.errors.CodecError` where it is about the points.
    """
    message = pb.Frame(sequence_number=sequence, capture_time=_timestamp(frame.timestamp))
    points, runs = checked_array("points", frame.points, expected="numbers of shape (N, 3)", error=CodecError), None
    if frame.sensor_origin is not None:
        points, runs = _with_sensors(message, points, frame.sensor_origin)
    message.point_cloud.CopyFrom(encode(points, codec, step=step, runs=runs).cloud)
    if frame.body_vertices is not None:
        message.body_vertices = _body(frame.body_vertices).tobytes()
    return message


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


def _timestamp(timestamp: float) -> float:
    try:
        seconds = float(timestamp) if isinstance(timestamp, (int, float, np.integer, np.floating)) else math.nan
    except OverflowError:
        seconds = math.inf
    if not math.isfinite(seconds):
        got = repr(timestamp)[:40] if isinstance(timestamp, (float, str, np.number)) else type(timestamp).__name__
        raise InvalidFrame(field="timestamp", expected="a finite number of seconds", got=got)
    return seconds


def _body(vertices: object) -> np.ndarray:
    vertices = checked_array("body_vertices", vertices, expected="numbers of shape (B, 3)", error=InvalidFrame)
    return vertices.astype("<f4", order="C")

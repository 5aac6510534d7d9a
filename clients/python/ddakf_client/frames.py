"""Frames of the caller as messages."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from ddakf_api.codec import encode, group_by_sensor
from ddakf_api.errors import InvalidFrame
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
    points, runs = np.asarray(frame.points), None
    if frame.sensor_origin is not None:
        points, runs = _with_sensors(message, points, np.asarray(frame.sensor_origin))
    message.point_cloud.CopyFrom(encode(points, codec, step=step, runs=runs).cloud)
    if frame.body_vertices is not None:
        message.body_vertices = _body(np.asarray(frame.body_vertices)).tobytes()
    return message


def _with_sensors(message: pb.Frame, points: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, list[int] | None]:
    """Names the sensors in the message; returns the points in runs by sensor, and the runs' lengths."""
    per_point = origin.ndim == 2 and origin.shape == points.shape
    if origin.dtype.kind not in "fiu" or not (origin.shape == (3,) or per_point) or not np.isfinite(origin).all():
        got = f"{origin.dtype} of shape {origin.shape}"
        raise InvalidFrame(field="sensor_origin", expected="finite numbers of shape (3,) or (N, 3)", got=got)
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
    if not isinstance(timestamp, (int, float, np.number)) or not math.isfinite(timestamp):
        raise InvalidFrame(field="timestamp", expected="a finite number of seconds", got=repr(timestamp)[:40])
    return float(timestamp)


def _body(vertices: np.ndarray) -> np.ndarray:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
        got = f"{vertices.dtype} of shape {vertices.shape}"
        raise InvalidFrame(field="body_vertices", expected="numbers of shape (B, 3)", got=got)
    return vertices.astype("<f4", order="C")

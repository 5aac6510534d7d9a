"""Frame input: every argument of a step is checked before anything changes."""

from __future__ import annotations

import math

import numpy as np

from ddakf.errors import InvalidFrame
from ddakf.kernels.preprocess import bounds
from ddakf.mesh import MAX_COORDINATE, Mesh  # float32 keeps a millimetre up to there
from ddakf.stages.grid import first_rows
from ddakf.types import FrameInput

MAX_POINTS = 1_000_000
MAX_SENSORS = 64  # each sensor costs a test of visibility per vertex
MAX_TIME = 1e12  # s: 30,000 years
BODY_FACTOR = 4.0  # largest ratio of a body's sizes in two poses; millimetres for metres give 1,000
LEAST_STEP = 1e-6  # s, shortest time between two frames


def check(given: FrameInput, last: float | None, body: Mesh | None) -> FrameInput:
    """The frame with arrays of the right type.

    Args:
        given: the arguments of ``Tracker.step``.
        last: time of the last frame, seconds; None before the first.
        body: as declared, or None.

    Raises:
        InvalidFrame: a shape, type, number or time that cannot be used.
    """
    points, sensor_origin, body_vertices = _positions("points", given.points), given.sensor_origin, given.body_vertices
    if len(points) > MAX_POINTS:
        raise InvalidFrame("points", f"at most {MAX_POINTS} points", str(len(points)))
    colors = None if given.colors is None else _colors(given.colors, len(points))
    time = _time(given.timestamp, last)
    if sensor_origin is not None:
        origin = _array("sensor_origin", sensor_origin, f"(3,) or ({len(points)}, 3)")
        if origin.shape != (3,) and origin.shape != (len(points), 3):
            raise InvalidFrame("sensor_origin", f"shape (3,) or ({len(points)}, 3)", str(origin.shape))
        sensor_origin = _finite("sensor_origin", np.atleast_2d(origin)).astype(np.float64, "C").reshape(origin.shape)
        if sensor_origin.shape == (0, 3):
            sensor_origin = None
        elif sensor_origin.ndim == 2 and (sensors := len(first_rows(sensor_origin))) > MAX_SENSORS:
            raise InvalidFrame("sensor_origin", f"at most {MAX_SENSORS} sensors", f"{sensors} distinct origins")
    if body_vertices is not None:
        if body is None:
            raise InvalidFrame("body_vertices", "none, as the tracker was made without a body", "an array")
        body_vertices = _positions("body_vertices", body_vertices)
        if len(body_vertices) != body.n_vertices:
            raise InvalidFrame("body_vertices", f"shape ({body.n_vertices}, 3), as declared", str(body_vertices.shape))
        body_vertices = body_vertices.astype(np.float64)
        lower, upper = np.empty(3), np.empty(3)
        bounds(body_vertices, 0.0, lower, upper)
        size = (upper - lower).max()
        if not body.size / BODY_FACTOR < size < body.size * BODY_FACTOR:
            raise InvalidFrame("body_vertices", f"a body about {body.size:.2g} m in size, as declared", f"{size:.2g} m")
    return FrameInput(np.ascontiguousarray(points, np.float32), time, sensor_origin, body_vertices, colors)


def positions(name: str, values, n: int) -> np.ndarray:
    """(n, 3) float64 metres or m/s, checked."""
    array = _positions(name, values)
    if len(array) != n:
        raise InvalidFrame(name, f"shape ({n}, 3)", str(array.shape))
    return np.array(array, np.float64, order="C")


def _colors(values, n: int) -> np.ndarray:
    array = _array("colors", values, f"({n}, 3)")
    if array.size == n == 0:
        return np.empty((0, 3), np.uint8)
    if array.shape != (n, 3):
        raise InvalidFrame("colors", f"shape ({n}, 3), one colour per point", str(array.shape))
    if array.dtype != np.uint8:
        raise InvalidFrame("colors", "numbers of type uint8", f"dtype {array.dtype}")
    return np.ascontiguousarray(array)


def _positions(name: str, values) -> np.ndarray:
    array = _array(name, values, "(N, 3)")
    if array.ndim != 2 or array.shape[1] != 3:
        if array.size == 0:
            return np.empty((0, 3))
        raise InvalidFrame(name, "shape (N, 3)", str(array.shape))
    return _finite(name, array)


def _array(name: str, values, shape: str) -> np.ndarray:
    try:
        array = np.asarray(values)
    except ValueError:
        raise InvalidFrame(name, f"an array of shape {shape}", "rows of different lengths") from None
    if array.dtype.kind not in "fiu" and array.size:
        raise InvalidFrame(name, "numbers", f"dtype {array.dtype}" if array.ndim else type(values).__name__)
    return array


def _finite(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind in "iu":  # the least integer has no absolute value of its type
        array = array.astype(np.float64)
    if array.size and not np.abs(array).max() <= MAX_COORDINATE:  # also false for a NaN
        bad = ~(np.isfinite(array) & (np.abs(array) <= MAX_COORDINATE)).all(axis=1)
        what = "finite metres" if not np.isfinite(array).all() else f"metres within {MAX_COORDINATE:g} of the origin"
        raise InvalidFrame(name, what, f"{bad.sum()} bad rows, the first at {bad.argmax()}: {array[bad.argmax()].tolist()}")
    return array


def _time(timestamp, last: float | None) -> float:
    try:
        if isinstance(timestamp, str | bytes | bytearray):
            raise TypeError
        time = float(timestamp)
    except (TypeError, ValueError, OverflowError):
        raise InvalidFrame("timestamp", "seconds", f"{timestamp!r:.40}") from None
    if not math.isfinite(time):
        raise InvalidFrame("timestamp", "finite seconds", repr(timestamp))
    if abs(time) > MAX_TIME:
        raise InvalidFrame("timestamp", f"seconds within {MAX_TIME:g}", f"{time:g}")
    if last is not None and (time <= last or time < last + LEAST_STEP):  # the sum may round to the last time
        raise InvalidFrame("timestamp", f"later than the last frame's {last:.9f} s by {LEAST_STEP:g} s", f"{time:.9f} s")
    return time

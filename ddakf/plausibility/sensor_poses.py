"""Sensor poses: how far each of several sensors is misplaced, learned where two of them see the same surface.

Sensors are calibrated to millimetres or centimetres. Where two of them overlap, a garment between two layers follows neither. The
distance of their layers along the normal tells how far they are shifted against each other, and frames of a garment that moves
show it from all sides. What all sensors have in common cannot be seen: their mean is taken for right, and its variance is part
of the garment's covariance. Turns are left out: about a garment in the middle of the sensors they are small.
"""

from __future__ import annotations

import numpy as np

from ddakf.kernels import preprocess as grids
from ddakf.kernels import sensor_poses as kernels
from ddakf.stages.frame_input import MAX_SENSORS
from ddakf.stages.grid import spread_rows
from ddakf.types import Estimate, FrameInput, Problem, Sensors, Setup, Sign, Track

SAME = 0.1  # m: an origin that moved less since the last frame is of the same sensor
NEIGHBOURS = 10  # points of one sensor in a neighbourhood, if the bounds of its radius allow it
MARGIN = 0.1  # m around the garment's last place, beyond which points do not count
FARTHEST = 0.1  # m, length of the longest shift
MAX_CELLS = 1 << 21
OFF = 0.005  # m, root mean square of the shifts from which on sensors are misplaced


def correct(setup: Setup, last: Track, frame: FrameInput) -> tuple[FrameInput, Sensors | None]:
    """The frame with its points and sensors where they are by what is known of the sensors, and that.

    Args:
        setup: constants of the tracker.
        last: after the last frame.
        frame: checked.
    """
    config, origin = setup.config.sensor_poses, frame.sensor_origin
    if config.sd <= 0:
        return frame, None
    if origin is None or len(frame.points) == 0 or (origin.ndim == 1 and last.sensors is None):
        return frame, last.sensors
    if origin.ndim == 1:
        origin = np.tile(origin, (len(frame.points), 1))
    distinct, sensor = np.empty((MAX_SENSORS, 3)), np.empty(len(origin), np.int32)
    distinct = distinct[: kernels.tell_apart(origin, distinct, sensor)]
    if len(distinct) == 1 and last.sensors is None:
        return frame, None
    sensors, own = _matched(last.sensors, distinct)
    sensor = own.astype(np.int32)[sensor]
    if sensors.wait > 0 or last.health.unplaced:
        sensors = sensors._replace(wait=max(sensors.wait - 1, 0))
    elif len(distinct) > 1:
        sensors = _look(setup, last, frame, sensors, sensor)
    points, place = np.empty_like(frame.points), np.empty_like(origin)
    kernels.move(frame.points, origin, sensor, sensors.shift, points, place)
    return frame._replace(points=points, sensor_origin=place), sensors


def _matched(known: Sensors | None, origin: np.ndarray) -> tuple[Sensors, np.ndarray]:
    """What is known of the sensors, with (C, 3) those of a frame among them, metres, and the index (C,) of each."""
    rows = np.arange(len(origin))
    if known is None:
        return unknown(origin), rows
    distance = np.linalg.norm(origin[:, None] - known.origin, axis=2)
    index = distance.argmin(axis=1)
    new = (distance.argmin(axis=0)[index] != rows) | (distance[rows, index] > SAME)
    if len(known.origin) + new.sum() > MAX_SENSORS:
        return unknown(origin), rows
    place = known.origin.copy()
    place[index[~new]] = origin[~new]
    index[new] = len(place) + np.arange(new.sum())
    return _joined(known._replace(origin=place), unknown(origin[new])), index


def unknown(origin: np.ndarray) -> Sensors:
    """Sensors at (C, 3) origins, metres, of whose shifts nothing is known."""
    n = len(origin)
    return Sensors(origin.copy(), np.zeros((n, 3)), np.zeros((3 * n, 3 * n)), np.zeros(3 * n))


def _joined(known: Sensors, more: Sensors) -> Sensors:
    n = len(known.vector)
    information = np.zeros((n + len(more.vector), n + len(more.vector)))
    information[:n, :n] = known.information
    arrays = (np.concatenate(pair) for pair in zip(known[:2], more[:2], strict=True))
    return Sensors(*arrays, information, np.concatenate([known.vector, more.vector]), known.time, known.wait)


def _look(setup: Setup, last: Track, frame: FrameInput, sensors: Sensors, sensor: np.ndarray) -> Sensors:
    """What is known after a look at a frame, of whose points (N,) ``sensor`` is the index."""
    config, n = setup.config.sensor_poses, len(sensors.origin)
    lower, upper, chosen = np.empty(3), np.empty(3), np.empty(len(frame.points), np.int32)
    grids.bounds(last.state.position, MARGIN, lower, upper)
    chosen = chosen[: grids.crop(frame.points, lower, upper, chosen)]
    chosen = chosen[spread_rows(len(chosen), config.points)]
    information, vector = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
    if len(chosen):
        sensor, farthest = sensor[chosen], np.abs(sensors.shift).max()
        near = frame.points[chosen] - sensors.shift[sensor]
        lower, upper = lower - farthest, upper + farthest
        radius = np.sqrt(NEIGHBOURS * 0.5 * setup.model.area * n / (np.pi * len(chosen)))  # one sensor sees half at most
        grid = _grid(lower, upper, float(np.clip(radius, config.radius, 2.0 * config.radius)))
        points, index = np.empty((3, len(near)), np.float32), np.empty(len(near), np.int32)
        grids.fill_grid(near, np.arange(len(near), dtype=np.int32), grid, points, index)
        eye, stride = sensors.origin - sensors.shift - lower, max(1, len(near) // config.neighbourhoods)
        kernels.accumulate(points, grid, sensor[index], eye, stride, information, vector)
    vector += information @ sensors.shift.ravel()  # the distances were measured between shifted points
    now, old = frame.timestamp, 0.0
    if sensors.time is not None:
        old = float(np.exp((sensors.time - now) / config.memory))
    information = old * sensors.information + information / config.distance_sd**2
    vector = old * sensors.vector + vector / config.distance_sd**2
    shift = np.linalg.solve(information + np.eye(3 * n) / config.sd**2, vector).reshape(n, 3)
    shift *= np.minimum(1.0, FARTHEST / np.maximum(np.linalg.norm(shift, axis=1), 1e-12))[:, None]
    return Sensors(sensors.origin, shift, information, vector, now, config.interval - 1)


def _grid(lower: np.ndarray, upper: np.ndarray, cell: float) -> grids.Grid:
    cell = max(cell, float(np.prod(upper - lower) / MAX_CELLS) ** (1.0 / 3.0))
    dims = ((upper - lower) / cell).astype(np.int64) + 1
    return grids.Grid(np.empty(int(np.prod(dims)) + 2, np.int32), lower, cell, dims)


def misplaced(problem: Problem, estimate: Estimate) -> Sign | None:
    """Sensors that see the same surface in different places."""
    sensors = problem.last.sensors
    if sensors is None:
        return None
    length = np.linalg.norm(sensors.shift, axis=1)
    if np.sqrt((length**2).mean()) < OFF:
        return None
    worst = int(length.argmax())
    x, y, z = sensors.origin[worst]
    where = f"of the one at ({x:.2f}, {y:.2f}, {z:.2f}) {1000 * length[worst]:.0f} mm from where the others see them"
    return Sign("sensor_origin", f"the sensors see the same surfaces in different places, those {where}")

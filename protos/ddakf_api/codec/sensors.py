"""Sensors of a point cloud: one run of consecutive points per sensor, in the order of ``Frame.sensors``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ddakf_api.errors import InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb

MAX_SENSORS = 64


def group_by_sensor(origins: np.ndarray) -> tuple[np.ndarray, list[int], np.ndarray]:
    """Groups points by the optical centre of their sensor.

    Args:
        origins: (N, 3) metres, one per point, at most 64 distinct.

    Returns:
        The permutation (N,) int64 that sorts the points into runs (stable inside each), the lengths of the runs, and the S
        distinct origins (S, 3).

    Raises:
        InvalidFrame: more than 64 distinct origins.
    """
    distinct, sensor = np.unique(origins, axis=0, return_inverse=True)
    if len(distinct) > MAX_SENSORS:
        raise InvalidFrame(
            field="sensor_origin", expected=f"at most {MAX_SENSORS} different origins", got=str(len(distinct))
        )
    sensor = sensor.ravel()
    return np.argsort(sensor, kind="stable"), np.bincount(sensor, minlength=len(distinct)).tolist(), distinct


def require_few_sensors(sensors: Sequence[pb.Sensor]) -> None:
    """Raises :class:`InvalidFrame` for more than 64. A sensor of two bytes in the message takes twenty times as much memory."""
    require_sensor_count(len(sensors))


def require_sensor_count(count: int) -> None:
    """Raises :class:`InvalidFrame` for more than 64 sensors."""
    if count > MAX_SENSORS:
        raise InvalidFrame(field="sensors", expected=f"at most {MAX_SENSORS}", got=str(count))


def sensor_origins(sensors: Sequence[pb.Sensor], count: int) -> np.ndarray | None:
    """The optical centres of a frame's points.

    Args:
        sensors: ``Frame.sensors``.
        count: N, the number of points.

    Returns:
        None for a frame without sensors, (3,) metres for one sensor, (N, 3) metres for several.

    Raises:
        InvalidFrame: too many sensors, a sensor without origin and pose, runs that do not sum to N, or an invalid pose.
    """
    if not sensors:
        return None
    require_few_sensors(sensors)
    origins = np.array([_origin(sensor, f"sensors[{index}]") for index, sensor in enumerate(sensors)])
    runs = [sensor.point_count for sensor in sensors]
    if len(sensors) == 1 and runs[0] == 0:
        return origins[0]
    if sum(runs) != count:
        raise InvalidFrame(field="sensors.point_count", expected=f"a sum of {count}, the points", got=str(sum(runs)))
    return origins[0] if len(sensors) == 1 else np.repeat(origins, runs, axis=0)


def pose_matrix(pose: pb.Pose, field: str) -> np.ndarray:
    """(3, 4) float64 [R | t] of a pose, finite. R is not checked.

    Raises:
        InvalidFrame: the pose has neither 12 finite numbers nor none (the identity).
    """
    matrix = np.array(pose.matrix or [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], np.float64)
    if len(matrix) != 12:
        raise InvalidFrame(field=f"{field}.matrix", expected="12 numbers", got=str(len(matrix)))
    if not np.isfinite(matrix).all():
        raise InvalidFrame(field=f"{field}.matrix", expected="finite numbers", got="NaN or infinity")
    return matrix.reshape(3, 4)


def _origin(sensor: pb.Sensor, field: str) -> tuple[float, float, float]:
    placement = sensor.WhichOneof("placement")
    if placement is None:
        raise InvalidFrame(field=field, expected="an origin or a pose", got="neither")
    if placement == "origin":
        origin = (sensor.origin.x, sensor.origin.y, sensor.origin.z)
    else:
        origin = tuple(pose_matrix(sensor.pose, f"{field}.pose")[:, 3].tolist())
    if not np.isfinite(origin).all():
        raise InvalidFrame(field=f"{field}.{placement}", expected="finite numbers", got=str(origin))
    return origin

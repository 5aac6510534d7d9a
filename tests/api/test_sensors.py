"""Sensors of a point cloud: grouping into runs, and the origins of points."""

import numpy as np
import pytest
from ddakf_api.codec import group_by_sensor, sensor_origins
from ddakf_api.errors import InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb


def sensor(x, count=0):
    return pb.Sensor(origin=pb.Vector3(x=x), point_count=count)


def test_points_are_grouped_into_runs_by_sensor():
    origins = np.array([[1.0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0]])
    order, runs, different = group_by_sensor(origins)
    assert runs == [3, 2]
    assert order.tolist() == [1, 3, 4, 0, 2]
    sensors = [sensor(place[0], count) for place, count in zip(different, runs, strict=True)]
    assert np.array_equal(sensor_origins(sensors, 5), origins[order])


def test_no_sensor_one_sensor_and_several():
    assert sensor_origins([], 7) is None
    assert sensor_origins([sensor(2.0)], 7).tolist() == [2, 0, 0]
    assert sensor_origins([sensor(2.0, 7)], 7).tolist() == [2, 0, 0]
    assert sensor_origins([sensor(1.0, 2), sensor(2.0, 0), sensor(3.0, 1)], 3)[:, 0].tolist() == [1, 1, 3]


def test_the_origin_of_a_pose_is_its_translation():
    pose = pb.Pose(matrix=[1, 0, 0, 4, 0, 1, 0, 5, 0, 0, 1, 6])
    assert sensor_origins([pb.Sensor(pose=pose)], 1).tolist() == [4, 5, 6]
    assert sensor_origins([pb.Sensor(pose=pb.Pose())], 1).tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("sensors", "said"),
    [
        ([sensor(0, 2), sensor(1, 2)], "a sum of 5, the points, got 4"),
        ([sensor(0, 4)], "a sum of 5, the points, got 4"),
        ([pb.Sensor()], "an origin or a pose"),
        ([sensor(float("nan"))], "finite"),
        ([pb.Sensor(pose=pb.Pose(matrix=[1.0] * 11))], "12 numbers"),
        ([sensor(0)] * 65, "at most 64"),
    ],
)
def test_invalid_sensors_are_refused(sensors, said):
    with pytest.raises(InvalidFrame, match=said):
        sensor_origins(sensors, 5)


def test_more_origins_than_sensors_are_refused():
    with pytest.raises(InvalidFrame, match="at most 64 different origins, got 100"):
        group_by_sensor(np.arange(300.0).reshape(100, 3))

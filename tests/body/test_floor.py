"""Floor: cloth does not hang lower than the wearer's lowest point, unless it is seen lower."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.body import floor
from ddakf.config import Start
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors import Sensor
from ddakf.physics import collision
from tests.stages.scenes import tube

GARMENT = tube()  # stands upright about the origin
LOWEST = float(GARMENT.vertices[:, 1].min())
N = GARMENT.n_vertices
AS_IT_IS = np.eye(3)
DROP = 0.03  # m, of half of the garment below the floor


def standing(below: float, tall: float = 1.7, axes=AS_IT_IS) -> np.ndarray:
    """(B, 3) corners of a body of this height that ends ``below`` the garment, metres."""
    corners = np.stack(np.meshgrid([-0.3, 0.3], [0.0, tall], [-0.2, 0.2], indexing="ij"), axis=-1).reshape(-1, 3)
    return (corners + [0.0, LOWEST - below, 0.0]) @ axes


def frame(start, now, garment=GARMENT.vertices, measured=None, config=None):
    """A frame of a garment that started beside a body in the pose ``start``, which now has the pose ``now``."""
    anchor = SimpleNamespace(
        bound=SimpleNamespace(pose=start, position=garment), measured=np.zeros(N, bool) if measured is None else measured
    )
    return SimpleNamespace(
        last=SimpleNamespace(anchor=anchor),
        body=SimpleNamespace(vertices=now),
        config=config or Config(),
        model=SimpleNamespace(collision=collision.build(GARMENT)),
    )


def lying(measured=None, below=0.5):
    """The half of the garment that hangs ``DROP`` and more below a body that has lain down, and what holds it up."""
    position = GARMENT.vertices
    body = standing(0.0) * [1.0, 0.2, 1.0]
    body[:, 1] += np.median(position[:, 1]) + DROP - body[:, 1].min()
    return floor.linearize(frame(standing(below), body, measured=measured), position), position[:, 1] - body[:, 1].min()


def test_cloth_under_the_lowest_point_of_the_body_is_pushed_up():
    found, height = lying()
    assert 0 < len(found.residual) < N
    np.testing.assert_array_equal(found.stencil[:, 0], np.flatnonzero(height < 0))
    np.testing.assert_allclose(found.residual, height[height < 0], atol=1e-12)
    np.testing.assert_allclose(found.jacobian[:, 0], np.tile([0.0, 1.0, 0.0], (len(found.residual), 1)))
    assert (found.weight > 0).all()


def test_cloth_that_is_seen_lower_has_a_lower_floor():
    _, height = lying()
    measured = np.zeros(N, bool)
    measured[np.argsort(height)[N // 4]] = True
    found, _ = lying(measured)
    assert len(found.residual) < np.count_nonzero(height < height[measured][0] + 1e-9)
    assert (height[found.stencil[:, 0]] < height[measured][0]).all()


def test_a_body_without_feet_knows_no_floor():
    assert lying(below=0.05)[0] is None


def test_cloth_above_the_floor_is_left_alone():
    assert floor.linearize(frame(standing(0.5), standing(0.5)), GARMENT.vertices) is None


@pytest.mark.parametrize("up", ["y", "z", "-y"])
def test_up_is_where_the_configuration_says(up):
    config = dataclasses.replace(Config(), start=Start(up=up))
    axes = config.start.to_y_up
    position, body = GARMENT.vertices @ axes, standing(0.5, axes=axes)
    low = body + (0.5 + DROP) * axes[1]
    found = floor.linearize(frame(body, low, position, config=config), position)
    np.testing.assert_allclose(found.jacobian[:, 0], np.tile(axes[1], (len(found.residual), 1)))
    if up == "z":  # a body that lies along the axis which is taken for upward
        assert floor.linearize(frame(body, low, position), position) is None


@pytest.mark.slow
def test_the_hidden_side_of_who_lies_down_stays_on_the_floor():
    sequence, camera, lowest = collection.load("dress_lie_loose_51"), Sensor("ring4"), {}
    for below in (Config().physics.floor_below, 10.0):  # with the floor, and without
        config = Config.from_dict({"physics": {"floor_below": below}})
        body = Mesh(sequence.body_vertices[0], sequence.body_faces)
        tracker = Tracker(Mesh(sequence.template, sequence.garment_faces), body=body, config=config)
        tracker.reset(sequence.garment_vertices[0])
        for k in range(1, 90):
            cloud, pose = camera.capture(sequence, k, np.random.default_rng(k)), sequence.body_vertices[k]
            result = tracker.step(
                cloud.points, timestamp=sequence.timestamp(k), sensor_origin=cloud.sensor_origin, body_vertices=pose
            )
        lowest[below] = result.vertices[:, 1].min() - sequence.garment_vertices[k][:, 1].min()
    floored, hanging = lowest.values()
    assert floored > -0.07
    assert hanging < -0.15

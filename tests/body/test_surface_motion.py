"""What the body's motion does to a garment near it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf.body import proximity
from tests.physics.shapes import ball, rotation

BODY = ball(3)
TOPOLOGY = proximity.build(BODY)
REACH, NEAR = 0.1, 0.05


def shell(offset, n=300):
    """Points at this height over the body."""
    directions = np.random.default_rng(0).normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * (0.2 + offset)


def carried(points, now, last=BODY.vertices):
    contact = proximity.closest_points(TOPOLOGY, proximity.refresh(TOPOLOGY, last), points, REACH)
    return proximity.surface_motion(TOPOLOGY, last, now, points, contact, REACH, NEAR)


@given(seed=st.integers(0, 2**32 - 1), offset=st.floats(-0.04, 0.04))
@settings(max_examples=25, deadline=None)
def test_a_rigid_motion_is_reproduced(seed, offset):
    R, t = rotation(seed), np.random.default_rng(seed).normal(size=3)
    motion = carried(shell(offset), BODY.vertices @ R.T + t)
    np.testing.assert_allclose(motion.position, shell(offset) @ R.T + t, atol=1e-8)
    np.testing.assert_allclose(motion.weight, 1.0)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_a_turn_is_reproduced(axis):
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(carried(shell(0.02), BODY.vertices @ R.T).position, shell(0.02) @ R.T, atol=1e-8)


def test_the_share_falls_smoothly_from_one_to_nothing():
    t = np.array([0.01, 0.02, -0.03])
    heights = np.linspace(0.0, 0.12, 200)
    points = np.outer(0.2 + heights, [1.0, 0.0, 0.0])
    motion = carried(points, BODY.vertices + t)
    np.testing.assert_allclose(motion.position, points + motion.weight[:, None] * t, atol=1e-12)
    assert (motion.weight[heights < NEAR] == 1.0).all()
    assert (motion.weight[heights > REACH] == 0.0).all()
    assert (np.diff(motion.weight) <= 0.0).all()
    assert np.abs(np.diff(motion.weight)).max() < 0.03


def test_uniform_growth_moves_points_out_without_turning_them():
    points = shell(0.02)
    expected = points + 0.1 * 0.2 * points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(carried(points, 1.1 * BODY.vertices).position, expected, atol=1e-3)


def test_neighbours_on_different_faces_stay_together():
    """A bend of the body: points a millimetre apart, three centimetres off it, stay about a millimetre apart."""
    x, y, z = BODY.vertices.T
    now = np.column_stack([x * np.cos(2 * z) - y * np.sin(2 * z), x * np.sin(2 * z) + y * np.cos(2 * z), z])
    angle = np.arange(0.0, 2 * np.pi, 0.001 / 0.23)
    path = 0.23 * np.column_stack([np.cos(angle) * np.cos(0.6), np.sin(angle), np.cos(angle) * np.sin(0.6)])
    before = np.linalg.norm(np.diff(path, axis=0), axis=1)
    after = np.linalg.norm(np.diff(carried(path, now).position, axis=0), axis=1)
    assert np.abs(after - before).max() < 0.5 * before.max()


@pytest.mark.parametrize("collapse", ["before", "after", "both"])
def test_degenerate_faces_leave_a_translation(collapse):
    flat = np.zeros_like(BODY.vertices)
    last = BODY.vertices if collapse == "after" else flat
    now = (BODY.vertices if collapse == "before" else flat) + 0.01
    points = np.random.default_rng(0).uniform(-0.02, 0.02, (20, 3)) + (BODY.vertices[:20] if collapse == "after" else 0)
    contact = proximity.closest_points(TOPOLOGY, proximity.refresh(TOPOLOGY, last), points, REACH)
    motion = proximity.surface_motion(TOPOLOGY, last, now, points, contact, REACH, NEAR)
    corners = TOPOLOGY.faces[contact.face]
    base, target = (np.einsum("nc,nca->na", contact.barycentric, pose[corners]) for pose in (last, now))
    np.testing.assert_allclose(motion.position, points + target - base, atol=1e-12)


def test_without_a_body_nothing_moves():
    far = shell(3.0)
    motion = carried(far, BODY.vertices + 1.0)
    np.testing.assert_array_equal(motion.position, far)
    assert not motion.weight.any()

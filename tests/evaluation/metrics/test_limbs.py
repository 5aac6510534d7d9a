"""Limbs of a sheet whose motion is known."""

import numpy as np
import pytest

from ddakf.evaluation import metrics

GRID = np.stack(np.meshgrid(np.arange(-0.3, 0.31, 0.02), np.arange(-0.5, 0.51, 0.02)), axis=2).reshape(-1, 2)
SHEET = np.column_stack([GRID, np.zeros(len(GRID))])
JOINTS = np.array([[-0.2, 0.4, -0.05], [0.2, -0.4, -0.05]])  # behind the sheet, as in a limb


def turned(points, degrees):
    angle = np.radians(degrees)
    return points @ np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])


def test_joints_go_with_the_surface_and_not_only_with_its_nearest_point():
    moved = turned(SHEET, 70) + [0.1, 0.2, -0.3]
    limbs = metrics.Limbs(SHEET, JOINTS)
    assert limbs.joints(moved) == pytest.approx(turned(JOINTS, 70) + [0.1, 0.2, -0.3], abs=1e-9)
    assert limbs.error_mm(moved, turned(JOINTS, 70) + [0.1, 0.2, -0.3]) == pytest.approx((0, 0), abs=1e-6)


def test_a_limb_that_is_left_behind_has_the_way_of_its_joint():
    tracked = JOINTS + [[0, 0, 0], [0, 0.4, 0.3]]
    assert metrics.Limbs(SHEET, JOINTS).error_mm(SHEET, tracked) == pytest.approx((250, 500))


def test_joints_that_stay_are_none_that_have_moved():
    error, moved = metrics.Limbs(SHEET, JOINTS).error_mm(SHEET, JOINTS + [0, 0.1, 0])
    assert error == pytest.approx(100)
    assert np.isnan(moved)


def test_a_joint_far_from_the_surface_is_not_counted():
    far = np.array([[0.0, 0.0, -0.5]])
    assert np.isnan(metrics.Limbs(SHEET, far).error_mm(SHEET, far)).all()
    both = np.concatenate([JOINTS, far])
    assert metrics.Limbs(SHEET, both).error_mm(SHEET, both + [0, 0.2, 0]) == pytest.approx((200, 200))

"""Penetration into a cube, by hand."""

import numpy as np
import pytest

from ddakf.evaluation import metrics
from ddakf.mesh import Mesh


def test_penetration_of_a_cube_by_hand():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                      [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    inside = metrics.Penetration(Mesh(corners, faces))
    points = np.array([[0.5, 0.5, 0.002], [0.5, 0.5, -0.01], [0.5, 0.006, 0.5], [2, 2, 2]])
    assert inside.depth(points, corners) == pytest.approx((2.0, 4.0, 0.5)), "4 mm is the mean of the two inside"
    assert inside(points, corners) == pytest.approx((2.0, 0.5))  # (2 + 0 + 6 + 0) / 4 mm
    assert inside(points, corners + [0, 0, 0.496]) == pytest.approx((1.0, 0.25)), "the body has moved"
    assert inside(points[:1], corners) == pytest.approx((2.0, 1.0)), "another number of vertices"
    clear = inside.depth(points[3:], corners)
    assert clear.mean_mm == clear.share == 0
    assert np.isnan(clear.violating_mm), "none is inside"
    assert np.isnan(inside.depth(points * np.nan, corners)).all(), "what is nowhere is not outside"


def test_violations_of_a_run_count_alike():
    # a frame with two of four vertices inside, 2 and 6 mm deep, and one with one of them, 1 mm deep: 9 mm on three
    assert metrics.violating_mm(np.mean([2.0, 0.25]), np.mean([0.5, 0.25])) == pytest.approx(3)

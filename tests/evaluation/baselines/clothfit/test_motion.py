"""Pendulums on a carried place obey their equation of motion at any frame rate."""

import numpy as np
import pytest

from ddakf.evaluation.baselines.clothfit.motion import SWINGS, Motion, swung

AT_REST = np.zeros((1, 3))


def test_a_swing_solves_its_equation():
    r, v = np.array([[0.01, 0.0, -0.02]]), np.array([[0.3, 0.1, 0.0]])
    one, two = swung(r, v, 1.2, 0.3, 0.05), swung(*swung(r, v, 1.2, 0.3, 0.02), 1.2, 0.3, 0.03)
    assert one[0] == pytest.approx(two[0])
    assert one[1] == pytest.approx(two[1])
    h, w = 1e-5, 2 * np.pi * 1.2
    after, before = swung(r, v, 1.2, 0.3, h), swung(r, v, 1.2, 0.3, -h)
    assert (after[0] - before[0]) / (2 * h) == pytest.approx(v, abs=1e-6)
    assert (after[1] - before[1]) / (2 * h) == pytest.approx(-(w**2) * r - 0.6 * w * v, rel=1e-5)


def test_steady_motion_leaves_nothing_behind():
    motion = Motion(AT_REST)
    for k in range(1, 10):
        moved = motion.step(AT_REST + [0.02 * k, 0, 0], k / 30)
    assert moved.velocity == pytest.approx(np.array([[0.6, 0, 0]]))
    assert moved.acceleration == pytest.approx(AT_REST, abs=1e-9)
    assert all(swing == pytest.approx(AT_REST, abs=1e-9) for swing in moved.swings)


def test_a_stop_throws_forward_and_dies_away():
    motion, place = Motion(AT_REST), 0.0
    for k in range(1, 200):
        place += 0.02 if k < 10 else 0.0
        moved = motion.step(AT_REST + [place, 0, 0], k / 30)
        if k == 10:
            assert moved.acceleration[0, 0] < 0
            assert all(swing[0, 0] > 0.005 for swing in moved.swings[: len(SWINGS) - 1])
    assert all(abs(swing[0, 0]) < 1e-4 for swing in moved.swings)


def test_the_first_frame_tells_no_speed_and_a_repeated_time_none_either():
    motion = Motion(AT_REST)
    assert not motion.step(AT_REST + 0.5, 7.0).velocity.any()
    assert not motion.step(AT_REST + 0.6, 7.0).velocity.any()
    assert motion.step(AT_REST + 0.7, 7.1).elapsed == pytest.approx(0.1)

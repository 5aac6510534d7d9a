"""Temporal metrics by hand."""

import numpy as np
import pytest

from ddakf.evaluation import metrics

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)


def test_flicker_is_of_the_error_and_not_of_the_motion():
    time = np.arange(5.0)[:, None, None]
    truth = SQUARE + np.sin(time)
    assert metrics.flicker_mm(truth + 0.1 + 0.02 * time, truth) == pytest.approx(0, abs=1e-9), "a steady drift is no flicker"
    jump = truth.copy()
    jump[::2] += np.array([0, 0, 0.001])
    assert metrics.flicker_mm(jump, truth) == pytest.approx(2)  # 1 - 2 0 + 1 mm in every frame
    assert np.isnan(metrics.flicker_mm(truth[:2], truth[:2]))


def test_frames_until_within():
    reference = np.ones(6)
    assert metrics.frames_until_within(np.array([3, 2, 1.5, 1.4, 1, 1]), reference, 1.5) == 3
    assert metrics.frames_until_within(np.array([1, 2, 1, 1, 1, 2]), reference, 1.5) == 3, "once is not enough"
    assert metrics.frames_until_within(np.array([1, 2, 1, 1, 1, 2]), reference, 1.5, hold=1) == 1
    assert metrics.frames_until_within(np.array([2.0, 2, 2, 2, 2, 1]), reference, 1.5) == 6, "the run ends within"
    assert metrics.frames_until_within(2 * reference, reference, 1.5) is None


def test_own_flicker_has_the_motion_in_it():
    time = np.arange(5.0)[:, None, None]
    assert metrics.own_flicker_mm(SQUARE + 0.1 * time) == pytest.approx(0, abs=1e-9)
    assert metrics.own_flicker_mm(SQUARE + [0, 0, 0.001] * time**2) == pytest.approx(2)
    assert np.isnan(metrics.own_flicker_mm(np.zeros((2, 4, 3))))


def test_acceleration_variance_by_hand():
    moving = SQUARE + [0.1, 0, 0.2] * np.arange(8.0)[:, None, None]
    assert metrics.acceleration_variance_mm2(moving) == pytest.approx(0, abs=1e-9), "a steady motion is smooth"
    quartic = SQUARE + [0.001, 0, 0] * np.arange(8.0)[:, None, None] ** 4  # what smoothing takes away has a steady acceleration
    assert metrics.acceleration_variance_mm2(quartic) == pytest.approx(0, abs=1e-6), "a variance, not a mean square"
    moving[::2, 0, 2] += 0.001
    # 0, 1, 0, 1 ... is 1/2 when smoothed; +-1/2 has second differences of +-2 mm, on one vertex of four
    assert metrics.acceleration_variance_mm2(moving) == pytest.approx(1)
    assert np.isnan(metrics.acceleration_variance_mm2(moving[:7]))


def test_a_frozen_mesh_wins_by_acceleration_variance_and_not_by_flicker():
    truth = SQUARE + 0.1 * np.sin(np.arange(20.0))[:, None, None]
    followed = truth + [0, 0, 0.001] * (np.arange(20) % 2)[:, None, None]
    frozen = np.repeat(SQUARE[None], 20, axis=0)
    assert metrics.acceleration_variance_mm2(frozen) == 0 < metrics.acceleration_variance_mm2(followed)
    assert metrics.flicker_mm(frozen, truth) > 10 * metrics.flicker_mm(followed, truth)

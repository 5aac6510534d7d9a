"""Skinning is smooth, follows rigid motions exactly, and does not depend on the axes."""

import numpy as np
import pytest

from ddakf.evaluation.baselines.clothfit.binding import Skinning, gaussian_weights, spread
from tests.evaluation.baselines.clothfit.scene import BODY, GARMENT, bent, turn


def skinning(count=12):
    weights, _ = gaussian_weights(GARMENT.vertices, BODY.vertices, count, 0.04, 0.5)
    return Skinning.at_start(weights, GARMENT.vertices, BODY.vertices)


def test_spread_takes_each_point_far_from_those_before():
    line = np.column_stack([np.arange(9.0), np.zeros(9), np.zeros(9)])
    assert spread(line, 4).tolist() == [0, 8, 4, 2]
    assert sorted(spread(line, 20)) == list(range(9))


def test_weights_sum_to_one_and_fall_off_with_the_distance():
    weights, distance = gaussian_weights(np.zeros((1, 3)), np.array([[0.1, 0, 0], [0.2, 0, 0], [0.9, 0, 0]]), 2, 0.1)
    a, b = np.exp(0), np.exp(-(0.2**2 - 0.1**2) / (2 * 0.1**2))
    assert weights.toarray() == pytest.approx(np.array([[a, b, 0]]) / (a + b))
    assert distance == pytest.approx([0.1])


def test_a_rigid_motion_of_the_body_is_one_of_the_garment():
    motion, shift = turn(0.8) @ turn(0.5, "x"), np.array([0.3, -0.2, 1.0])
    rotation, _, carried = skinning().carry(BODY.vertices @ motion.T + shift)
    assert carried == pytest.approx(GARMENT.vertices @ motion.T + shift, abs=1e-12)
    assert rotation == pytest.approx(np.broadcast_to(motion, rotation.shape), abs=1e-9)


def test_a_bent_body_bends_the_garment_smoothly():
    carried = skinning().carry(bent(BODY.vertices, 0.6))[2]
    assert np.abs(carried - bent(GARMENT.vertices, 0.6)).max() < 0.01
    edges = GARMENT.edges
    before, after = (np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (GARMENT.vertices, carried))
    assert (np.abs(after / before - 1) < 0.35).all()

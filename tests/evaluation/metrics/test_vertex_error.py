"""Errors of vertices by hand."""

import numpy as np
import pytest

from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_rmse_is_three_four_five():
    estimate = SQUARE + np.array([0.003, 0, 0.004])
    assert metrics.rmse_mm(estimate, SQUARE) == pytest.approx(5)
    assert metrics.normal_rmse_mm(estimate, SQUARE, FACES) == pytest.approx(4)
    assert metrics.tangential_rmse_mm(estimate, SQUARE, FACES) == pytest.approx(3)


def test_rmse_weighs_vertices_not_frames():
    estimate = SQUARE.copy()
    estimate[0, 2] = 0.01
    assert metrics.rmse_mm(estimate, SQUARE) == pytest.approx(5)  # sqrt(10^2 / 4)


def test_shapes_must_agree():
    with pytest.raises(InvalidArgument, match="shape"):
        metrics.rmse_mm(SQUARE[:2], SQUARE)


def test_normal_and_tangential_parts_make_up_the_whole():
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(4, 3))
    truth[3] = truth[0]  # the second triangle has no area, so that its own corner has no normal
    estimate = truth + 0.01 * rng.normal(size=(4, 3))
    normal, tangential = metrics.normal_rmse_mm(estimate, truth, FACES), metrics.tangential_rmse_mm(estimate, truth, FACES)
    assert normal**2 + tangential**2 == pytest.approx(metrics.rmse_mm(estimate, truth) ** 2)
    assert min(normal, tangential) > 1

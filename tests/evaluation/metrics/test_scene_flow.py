"""Scene flow by hand."""

import numpy as np
import pytest

from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics


def test_end_point_error_by_hand():
    truth = np.array([[0.1, 0, 0], [0, 0, 0], [0, 0.2, 0]])
    flow = truth + [[0.03, 0.04, 0], [0.03, 0, 0.03], [0, 0.01, 0]]  # 50, 42.4 and 10 mm off
    result = metrics.end_point_error(flow, truth)
    assert result.mean_mm == pytest.approx((50 + 30 * np.sqrt(2) + 10) / 3)
    assert metrics.end_point_error(flow[1:], truth[1:]).within_5cm == 1
    assert metrics.end_point_error(truth[1:2] + [[0.0505, 0, 0]], truth[1:2]).within_5cm == 0
    assert metrics.end_point_error(truth[1:2] + [[0.0495, 0, 0]], truth[1:2]).within_5cm == 1
    assert metrics.end_point_error(flow + [0.005, 0, 0], truth).within_5cm == pytest.approx(2 / 3), "53, 46 and 11 mm"


def test_points_without_truth_do_not_count():
    truth = np.array([[0.0, 0, 0], [-np.inf, 0, 0]])
    assert metrics.end_point_error(np.zeros((2, 3)), truth) == (0, 1, 1)
    nothing = metrics.end_point_error(np.zeros((1, 3)), truth[1:])
    assert nothing.n == 0
    assert np.isnan(nothing.mean_mm)


def test_a_method_that_says_nothing_of_a_point_is_not_right_there():
    result = metrics.end_point_error(np.array([[0.0, 0, 0], [np.nan, 0, 0]]), np.zeros((2, 3)))
    assert result.within_5cm == 0.5
    assert np.isnan(result.mean_mm)
    with pytest.raises(InvalidArgument, match="flow"):
        metrics.end_point_error(np.zeros((2, 3)), np.zeros((3, 3)))

"""Rank statistics by hand."""

import numpy as np
import pytest

from ddakf.evaluation import metrics


def test_spearman_sees_order_only():
    a = np.array([1.0, 2, 3, 4])
    assert metrics.spearman(a, np.exp(a)) == pytest.approx(1)
    assert metrics.spearman(a, -(a**3)) == pytest.approx(-1)
    assert metrics.spearman(a, np.array([2.0, 1, 4, 3])) == pytest.approx(0.6)  # 1 - 6 * 4 / (4 * 15)
    assert metrics.spearman(a, np.array([1.0, 1, 2, 2])) == pytest.approx(np.sqrt(0.8))
    assert np.isnan(metrics.spearman(a, np.ones(4)))


def test_area_under_the_curve_by_hand():
    positive = np.array([True, False, True, False])
    assert metrics.roc_auc(np.array([3.0, 1, 4, 2]), positive) == 1
    assert metrics.roc_auc(-np.array([3.0, 1, 4, 2]), positive) == 0
    assert metrics.roc_auc(np.array([2.0, 1, 4, 3]), positive) == 0.75  # three of four pairs are in order
    assert metrics.roc_auc(np.ones(4), positive) == 0.5
    assert np.isnan(metrics.roc_auc(np.ones(2), np.array([True, True])))

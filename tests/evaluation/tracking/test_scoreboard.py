"""The summary of a run, on results with known numbers."""

import numpy as np
import pytest

from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.tracking.scoreboard import Scoreboard
from ddakf.mesh import Mesh
from ddakf.results import FrameResult

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
GARMENT = Mesh(SQUARE, np.array([[0, 1, 2], [0, 2, 3]]))


def _result(vertices, state, sd):
    covariance = np.tile(np.eye(3) * sd**2, (4, 1, 1))
    observed, sigma = np.array([True, True, False, False]), np.full(4, sd)
    return FrameResult(vertices, 0 * vertices, covariance, sigma, sigma, observed, 0.5, 0.5, 0.5, state)


def test_the_summary_says_what_went_in():
    scores = Scoreboard(GARMENT)
    points = np.array([[0.5, 0.5, 0.013]])
    estimate = SQUARE + np.array([0, 0, 0.003])
    estimate[:2, 0] += 0.004
    scores.add(CapturedFrame(1, 0.1, points, truth=SQUARE), _result(estimate, "tracking", 0.01), 0.010)
    scores.add(CapturedFrame(2, 0.2, points, truth=SQUARE), _result(SQUARE, "recovering", 0.01), 0.030)
    summary = scores.summary()
    assert summary["frames"] == 2
    assert summary["states"] == {"tracking": 0.5, "recovering": 0.5}
    assert summary["ms_p50"] == pytest.approx(20)
    assert summary["fps"] == pytest.approx(50)
    assert summary["rmse_mm"] == pytest.approx(np.sqrt((25 + 25 + 9 + 9) / 4) / 2)
    assert summary["normal_rmse_mm"] == pytest.approx(1.5)
    assert summary["nees3"] == pytest.approx((0.25 + 0.25 + 0.09 + 0.09) / 8 / 3)
    assert summary["nees3_observed"] == pytest.approx(0.25 / 2 / 3)
    assert summary["nees3_hidden"] == pytest.approx(0.09 / 2 / 3)
    assert summary["coverage90"] == 1
    assert summary["residual_mean_mm"] == pytest.approx((10 + 13) / 2, rel=1e-5)
    assert summary["reliability"] == 0.5


def test_without_truth_and_points_there_are_no_errors():
    scores = Scoreboard(GARMENT)
    scores.add(CapturedFrame(1, 0.1, np.zeros((0, 3))), _result(SQUARE, "tracking", 0.01), 0.010)
    summary = scores.summary()
    assert summary["rmse_mm"] is None
    assert summary["coverage90"] is None
    assert summary["residual_p95_mm"] is None


def test_saved_results_are_copies_of_every_frame(tmp_path):
    scores, moving = Scoreboard(GARMENT), SQUARE.copy()
    for k in range(3):
        scores.add(CapturedFrame(k, k / 10, np.zeros((0, 3))), _result(moving, "tracking", 0.01), 0.01)
        moving += 1  # results may be views of a buffer that the next step overwrites
    scores.save(tmp_path / "r.npz")
    saved = np.load(tmp_path / "r.npz")
    assert np.array_equal(saved["vertices"], np.stack([SQUARE, SQUARE + 1, SQUARE + 2]).astype(np.float32))
    assert saved["sigma"].shape == (3, 4)
    assert saved["states"].tolist() == ["tracking"] * 3
    assert saved["timestamps"].tolist() == [0, 0.1, 0.2]
    assert saved["reliability"].shape == (3,)
    assert np.array_equal(saved["faces"], GARMENT.faces)

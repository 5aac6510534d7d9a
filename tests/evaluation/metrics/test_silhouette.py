"""Silhouettes of boxes, whose overlap is known."""

import numpy as np
import pytest

from ddakf.evaluation import metrics

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                  [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
SHEET, SHEET_FACES = CORNERS[[1, 5, 7, 3]] * [1, 1, 0], np.array([[0, 1, 2], [0, 2, 3]])
PIXEL = 2 / 285  # m, at the distance of the cameras


def test_of_the_same_box_is_one():
    box = 0.3 * CORNERS + [5, -2, 7]
    assert metrics.silhouette_iou(box, box, FACES) == 1


def test_of_a_raised_sheet_by_hand():
    """20 of 200 rows of pixels: 180 are in both, 220 in one of them. From the side there is nothing to see of it."""
    sheet = 100 * PIXEL * SHEET
    assert metrics.silhouette_iou(sheet + [0, 20 * PIXEL, 0], sheet, SHEET_FACES) == pytest.approx(180 / 220, abs=0.01)
    assert metrics.silhouette_iou(sheet + [20 * PIXEL, 0, 0], sheet, SHEET_FACES) == pytest.approx(180 / 220, abs=0.01)


def test_is_the_mean_of_four_cameras():
    """A needle as wide as deep, moved along x by its own width: gone for the cameras along z, unchanged for those along x."""
    needle = CORNERS * [0.02, 0.5, 0.02]
    assert metrics.silhouette_iou(needle + [0.05, 0, 0], needle, FACES) == pytest.approx(0.5, abs=0.03)


def test_cameras_go_with_the_truth():
    box = 0.3 * CORNERS
    here, there = metrics.silhouette_cameras(box), metrics.silhouette_cameras(box + [9, 0, 0])
    assert np.allclose([b.eye - a.eye for a, b in zip(here, there, strict=True)], [9, 0, 0])
    assert np.allclose([np.hypot(*camera.eye[[0, 2]]) for camera in here], 2)
    assert np.allclose([camera.eye[1] for camera in here], 0), "horizontal"


def test_of_what_is_elsewhere_is_zero():
    box = 0.3 * CORNERS
    assert metrics.silhouette_iou(box + [0, 50, 0], box, FACES) == 0
    assert np.isnan(metrics.silhouette_iou(0 * box, 0 * box, FACES)), "without an area nothing is to be seen"
    broken = np.where(np.arange(8)[:, None] == 3, np.nan, box)
    assert np.isnan(metrics.silhouette_iou(broken, box, FACES)), "a face less is no smaller garment"


def test_the_overlap_with_a_measured_silhouette_is_told_both_ways():
    measured, drawn = np.zeros((10, 10), bool), np.zeros((10, 10), bool)
    measured[:8], drawn[4:9] = True, True  # 80 and 50 pixels, 40 of them in both
    overlap = metrics.silhouette_overlap(drawn, measured)
    assert (overlap.iou, overlap.covered, overlap.inside) == pytest.approx((40 / 90, 40 / 80, 40 / 50))
    nothing = metrics.silhouette_overlap(np.zeros_like(drawn), measured)
    assert nothing[:2] == (0, 0)
    assert np.isnan(nothing.inside)

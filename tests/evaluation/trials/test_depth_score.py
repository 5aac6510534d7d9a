"""Depth scores of a wall in front of a camera, by hand."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from PIL import Image

from ddakf.evaluation.datasets import DepthRecording
from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.trials.depth_score import DepthScore
from ddakf.evaluation.trials.estimates import FrameEstimate
from ddakf.evaluation.trials.recorded_runs import recording_row

ROOT = Path(__file__).parents[3]
CAMERA = Camera.at_origin(Intrinsics(width=100, height=80, fx=100, fy=100, cx=49.5, cy=39.5))
FRAMES = 6


@pytest.fixture(scope="module")
def recording():
    """A wall of 60 by 40 pixels that comes nearer by 10 mm per frame, with a joint behind its middle."""
    depth = np.zeros((FRAMES, 80, 100), np.uint16)
    depth[:, 20:60, 20:80] = (2000 - 10 * np.arange(FRAMES))[:, None, None]
    joints = np.stack([[[0, 0, 0.01 * t - 2.05]] for t in range(FRAMES)])
    return DepthRecording("wall", depth, CAMERA, 30.0, smooth=False, joints=joints)


def test_a_surface_on_the_images_predicts_the_columns_held_out(recording):
    garment = recording.template(0)
    score = DepthScore(recording, garment, 0)
    here = score(3, garment.vertices + [0, 0, 0.03])
    assert here["held_out_mm"] == pytest.approx(0, abs=0.01)
    assert here["held_out_share"] > 0.9  # the template's border is half a cell inside
    assert here["silhouette_inside"] == 1
    assert here["silhouette_covered"] == pytest.approx(here["iou"])
    assert here["limb_mm"] == pytest.approx(0, abs=1e-6)
    behind = score(3, garment.vertices - [0, 0, 0.02])
    assert behind["held_out_mm"] == pytest.approx(50, abs=0.01)
    assert behind["held_out_share"] == 0
    assert behind["limb_mm"] == pytest.approx(50)
    assert np.isnan(behind["moved_limb_mm"])


def test_a_surface_beside_the_person_covers_nothing_and_predicts_nothing(recording):
    garment = recording.template(0)
    beside = DepthScore(recording, garment, 0)(1, garment.vertices + [5, 0, 0])
    assert (beside["held_out_share"], beside["iou"], beside["silhouette_covered"]) == (0, 0, 0)
    assert np.isnan(beside["held_out_mm"])


def follower(garment, start, body):
    """Follows the wall, and is left 5 mm off by its way back."""
    seen = []

    def step(frame):
        back = frame.timestamp > (FRAMES - 1) / 30 + 1e-9
        seen.append(len(frame.points))
        return FrameEstimate(start + [0.005 * back, 0, 0.01 * frame.number])

    step.seen = seen
    return step


def test_a_run_has_the_scores_of_its_frames_and_the_drift_of_its_return(recording):
    made = []
    row = recording_row(lambda *args: made.append(follower(*args)) or made[0], recording, range(1, FRAMES), Sensor(), 1)
    assert row["frames_tracked"] == FRAMES - 1
    assert row["held_out_mm"] == pytest.approx(0, abs=0.01)
    assert row["limb_mm"] == pytest.approx(0, abs=1e-6)
    assert row["moved_limb_mm"] is None
    assert row["per_frame"]["number"] == list(range(1, FRAMES))
    assert row["drift_mm"] == pytest.approx(5)
    assert len(made[0].seen) == 2 * (FRAMES - 1)  # there, and back to the template's frame
    assert set(made[0].seen) == {54 * 40}  # 6 of 60 columns are held out


@pytest.mark.slow
def test_each_recording_gets_a_sheet_and_an_animation(tmp_path):
    """Of a wall that comes nearer: the surface covers it, grey and orange are its rim."""
    folder = tmp_path / "depth/utd-mhad"
    folder.mkdir(parents=True)
    depth = np.zeros((240, 320, 4), np.int32)
    depth[60:180, 120:200] = 2000 - 10 * np.arange(4)
    scipy.io.savemat(folder / "wall_depth.mat", {"d_depth": depth})
    command = [sys.executable, ROOT / "benchmarks/depth_pictures.py", "--out", tmp_path / "out"]
    subprocess.run(command, check=True, env=os.environ | {"DDAKF_DATA": str(tmp_path)}, timeout=300)
    with Image.open(tmp_path / "out/wall.webp") as animation:
        assert animation.n_frames == 3
        pixels = np.asarray(animation.convert("RGB"), int)
    blue = (pixels[..., 2] > pixels[..., 0] + 40).mean()
    assert blue == pytest.approx(120 * 80 / (240 * 320), rel=0.15)
    with Image.open(tmp_path / "out/wall.png") as sheet:
        assert sheet.size == (3 * 3 * 640 // 5, 480)

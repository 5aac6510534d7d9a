"""Depth recordings of UTD-MHAD with their skeletons, made from a wall with a box before it."""

import numpy as np
import pytest
from scipy.io import savemat

from ddakf.errors import InvalidFile
from ddakf.evaluation.datasets import KINECT, load_depth
from ddakf.evaluation.datasets.captures.utd_mhad import LIMBS
from ddakf.evaluation.sensors.camera import Camera

FRAMES = 5


@pytest.fixture
def folder(tmp_path):
    """Depth images as the sensor delivers them, mirrored: a box at the left of the picture, 2 m away, that moves by a column."""
    images = np.zeros((KINECT.height, KINECT.width, FRAMES), np.uint16)
    for frame in range(FRAMES):
        images[100:140, 20 + frame : 60 + frame, frame] = 2000
    savemat(tmp_path / "a1_depth.mat", {"d_depth": images})
    return tmp_path


def skeleton():
    """Joints in the middle of the box, in the sensor's axes: x to the left, y up, z forward."""
    column = np.arange(39.5, 39.5 + FRAMES)
    x = 2 * (column - (KINECT.width - 1 - KINECT.cx)) / KINECT.fx
    y = np.full(FRAMES, 2 * (KINECT.cy - 119.5) / KINECT.fy)
    return np.tile(np.stack([x, y, np.full(FRAMES, 2.0)])[None], (20, 1, 1))


def test_the_joints_are_on_what_the_camera_sees_in_every_frame(folder):
    savemat(folder / "a1_skeleton.mat", {"d_skel": skeleton()})
    recording = load_depth(folder / "a1_depth.mat")
    assert recording.joints.shape == (FRAMES, len(LIMBS), 3)
    for frame in range(FRAMES):
        points = recording.cloud(frame).points
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        assert recording.joints[frame] == pytest.approx(np.tile(middle, (len(LIMBS), 1)), abs=0.005)


def test_a_recording_has_no_joints_without_a_skeleton(folder):
    assert load_depth(folder / "a1_depth.mat").joints is None


def test_a_skeleton_of_another_length_is_refused(folder):
    savemat(folder / "a1_skeleton.mat", {"d_skel": skeleton()[:, :, 1:]})
    with pytest.raises(InvalidFile, match=r"a1_skeleton.mat: d_skel: expected .*\(20, 3, 5\).* got \(20, 3, 4\)"):
        load_depth(folder / "a1_depth.mat")


def test_columns_that_are_held_out_have_no_points_and_all_others_have(folder):
    whole = load_depth(folder / "a1_depth.mat")
    part = whole.without_columns(10)
    camera = Camera.at_origin(KINECT)
    columns = [np.unique(camera.project(each.cloud(0).points)[:, 0].round()) for each in (whole, part)]
    held_out = np.arange(KINECT.width)[part.held_out_columns]
    assert len(held_out) == KINECT.width / 10
    assert np.array_equal(columns[1], np.setdiff1d(columns[0], held_out))
    assert len(columns[1]) < len(columns[0])
    assert np.array_equal(part.depth[0], whole.depth[0])  # which is still there to compare with
    assert np.array_equal(part.template(0).vertices, whole.template(0).vertices)

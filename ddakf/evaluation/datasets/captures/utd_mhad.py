"""Kinect depth of UTD-MHAD: people in motion, background removed.

Points are in the frame of the sensor: metres, y up, right-handed, the sensor at the origin and looking along -z.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile
from ddakf.evaluation.datasets.captures.recording import DepthRecording, positive_rate
from ddakf.evaluation.datasets.formats.matlab import read_arrays
from ddakf.evaluation.sensors.camera import Camera, Intrinsics

# The Kinect for Windows delivers mirrored images: people's left hands appear on the left. They are mirrored back, and
# with them the principal point (160, 120) that fits the recordings.
KINECT = Intrinsics(width=320, height=240, fx=285.63, fy=285.63, cx=159.0, cy=120.0)
LIMBS = (5, 6, 9, 10, 13, 14, 17, 18)  # of the 20 joints: elbow and wrist, knee and ankle of either side
DEPTH, SKELETON = "_depth", "_skeleton"  # the ends of the names of a recording's two files


def load_depth(path, fps: float = 30.0) -> DepthRecording:
    """Reads a Kinect recording of UTD-MHAD: ``d_depth`` (240, 320, T), millimetres, in a MATLAB file ``..._depth.mat``. Its
    joints are those of :data:`LIMBS`, if ``..._skeleton.mat`` is beside it.

    Raises:
        InvalidFile: no such file, no MATLAB file, no ``d_depth`` of that shape, a skeleton that does not fit.
    """
    path = Path(path)
    depth = read_arrays(path, ["d_depth"]).get("d_depth")
    if depth is None:
        raise InvalidFile(f"{path.name}: d_depth", "to be in the file", "nothing of that name")
    shape = (KINECT.height, KINECT.width)
    if depth.ndim != 3 or depth.shape[:2] != shape or depth.shape[2] == 0:
        expected = f"millimetres of shape ({KINECT.height}, {KINECT.width}, T)"
        raise InvalidFile(f"{path.name}: d_depth", expected, f"{depth.dtype} {depth.shape}")
    images = np.clip(np.nan_to_num(depth, posinf=0), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    upright = np.ascontiguousarray(images.transpose(2, 0, 1)[:, :, ::-1])
    skeleton = path.with_name(path.name.replace(DEPTH, SKELETON))
    joints = _load_joints(skeleton, len(upright)) if skeleton != path and skeleton.is_file() else None
    return DepthRecording(path.stem, upright, Camera.at_origin(KINECT), positive_rate(fps), joints=joints)


def _load_joints(path: Path, frames: int) -> np.ndarray:
    """(T, 8, 3) metres in the frame of the sensor: ``d_skel`` (20, 3, T), which is turned about the vertical there."""
    joints = read_arrays(path, ["d_skel"]).get("d_skel")
    shape = None if joints is None else joints.shape
    if shape != (20, 3, frames):
        expected = f"metres of shape (20, 3, {frames}), as many frames as depth images"
        raise InvalidFile(f"{path.name}: d_skel", expected, str(shape))
    return joints.transpose(2, 0, 1)[:, LIMBS].astype(np.float64) * [-1, 1, -1]

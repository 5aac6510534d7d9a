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


def load_depth(path, fps: float = 30.0) -> DepthRecording:
    """Reads a Kinect recording of UTD-MHAD: ``d_depth`` (240, 320, T), millimetres, in a MATLAB file.

    Raises:
        InvalidFile: no such file, no MATLAB file, no ``d_depth`` of that shape.
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
    return DepthRecording(path.stem, upright, Camera.at_origin(KINECT), positive_rate(fps))

"""Recordings of real sensors: frames of points without ground truth, from depth images or from files."""

from __future__ import annotations

import re
from collections.abc import Sequence as Ordered
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.evaluation.datasets.captures.depth_template import JUMP, smoothed, template_from_depth
from ddakf.evaluation.sensors.camera import Camera
from ddakf.evaluation.sensors.captured_frame import Cloud
from ddakf.files.depth import without_fliers
from ddakf.mesh import Mesh

MM = 1e-3  # metres


class Recording(Protocol):
    """Frames of a sensor without ground truth."""

    name: str
    fps: float

    def __len__(self) -> int: ...

    def timestamp(self, frame: int) -> float:
        """Seconds since frame 0."""

    def cloud(self, frame: int) -> Cloud: ...

    def template(self, frame: int = 0) -> Mesh:
        """A garment mesh from one frame."""


@dataclass(frozen=True, eq=False)
class DepthRecording:
    """Depth images of one camera, background removed.

    Attributes:
        name: of the file, without its ending.
        depth: T images (H, W) uint16 millimetres, 0 in pixels without a depth: an array, or a sequence that reads them lazily.
        camera: in whose world the points are.
        fps: frames per second.
        smooth: even out the sensor's depth steps (22 mm at 2.8 m), which otherwise make every local plane face the
            camera.
        times: (T,) seconds, or None where the frames are evenly spaced.
    """

    name: str
    depth: np.ndarray | Ordered[np.ndarray]
    camera: Camera
    fps: float
    smooth: bool = True
    times: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.depth)

    def timestamp(self, frame: int) -> float:
        """Seconds since frame 0."""
        return frame / self.fps if self.times is None else float(self.times[frame] - self.times[0])

    def cloud(self, frame: int) -> Cloud:
        """The points of one frame without edge fliers, and the camera's position."""
        depth = self.depth[frame] * MM
        if self.smooth:
            depth = smoothed(depth, JUMP, passes=1)
        points = self.camera.unproject(depth, without_fliers(depth, JUMP))
        return Cloud(points.astype(np.float32), self.camera.eye)

    def template(self, frame: int = 0) -> Mesh:
        """Grid mesh of one frame, about 3,000 vertices."""
        return template_from_depth(self.depth[frame] * MM, self.camera)


def positive_rate(fps: float) -> float:
    """Checks a frame rate.

    Raises:
        InvalidArgument: not a positive number.
    """
    if not 1e-6 < fps < 1e6:
        raise InvalidArgument("fps", "a positive number of frames per second", str(fps))
    return float(fps)


def by_number(path: Path) -> list[int]:
    """Sort key of a frame: the numbers in its file name."""
    return [int(digits) for digits in re.findall(r"\d+", path.name)] or [0]

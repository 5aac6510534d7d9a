"""Recordings of real sensors: frames of points without ground truth, from depth images or from files."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets.captures.depth_template import JUMP, smoothed, template_from_depth
from ddakf.evaluation.datasets.formats.depth_files import read_numbers
from ddakf.evaluation.sensors.camera import Camera
from ddakf.evaluation.sensors.captured_frame import Cloud, ColouredCloud
from ddakf.files.depth import seen, without_fliers
from ddakf.mesh import Mesh

MM = 1e-3  # metres
SHORTEST = 1e-6  # s between two frames
TIMES = "timestamps.txt"  # file of the frames' times


class Recording(Protocol):
    """Frames of a sensor without ground truth."""

    name: str
    fps: float

    def __len__(self) -> int: ...

    def timestamp(self, frame: int) -> float:
        """Seconds since frame 0."""

    def cloud(self, frame: int) -> Cloud | ColouredCloud: ...

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
        joints: (T, J, 3) metres in the same world, of a body tracker that watched the person, or None.
        colors: T images (H, W, 3) uint8 of what the pixels see, or None.
        held_out: every such column of pixels, from the middle of the first ones on, is left out of the clouds; 0 for none.
    """

    name: str
    depth: np.ndarray | Ordered[np.ndarray]
    camera: Camera
    fps: float
    smooth: bool = True
    times: np.ndarray | None = None
    joints: np.ndarray | None = None
    colors: Ordered[np.ndarray] | None = None
    held_out: int = 0

    def __len__(self) -> int:
        return len(self.depth)

    def without_columns(self, every: int) -> DepthRecording:
        """The recording whose clouds lack every such column of pixels, which can then be predicted."""
        return replace(self, held_out=every)

    @property
    def held_out_columns(self) -> slice:
        """The columns of pixels that the clouds lack."""
        return slice(self.held_out // 2, None, self.held_out) if self.held_out else slice(0)

    def timestamp(self, frame: int) -> float:
        """Seconds since frame 0."""
        return frame / self.fps if self.times is None else float(self.times[frame] - self.times[0])

    def cloud(self, frame: int) -> Cloud | ColouredCloud:
        """The points of one frame without edge fliers, the camera's position, and the colours where they are known."""
        depth = self.depth[frame] * MM
        depth[:, self.held_out_columns] = 0
        if self.smooth:
            depth = smoothed(depth, JUMP, passes=1)
        keep = without_fliers(depth, JUMP) & seen(depth)
        cloud = Cloud(self.camera.unproject(depth, keep).astype(np.float32), self.camera.eye)
        return cloud if self.colors is None else ColouredCloud(*cloud, self.colors[frame][keep])

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


def frame_times(path: Path, count: int) -> np.ndarray | None:
    """(count,) seconds of ``timestamps.txt``; None without the file.

    Raises:
        InvalidFile: another number of times, or times that do not rise.
    """
    if not path.is_file():
        return None
    times = read_numbers(path).ravel()
    if len(times) != count:
        raise InvalidFile(path.name, f"{count} numbers, one per frame", f"{len(times)}")
    early = np.flatnonzero(np.diff(times) < SHORTEST) + 1
    if len(early):
        got = f"{times[early[0]]:.9g} after {times[early[0] - 1]:.9g}"
        raise InvalidFile(path.name, f"seconds, each at least {SHORTEST:g} after the one before", got)
    return times


def rate_of(times: np.ndarray | None, otherwise: float) -> float:
    """Mean frames per second of these times, or the other rate where there are not two."""
    return otherwise if times is None or len(times) < 2 else (len(times) - 1) / (times[-1] - times[0])


def visible(paths: Iterable[Path]) -> list[Path]:
    """Files without a dot before their names: those are the copies of attributes that macOS writes beside files."""
    return [path for path in paths if not path.name.startswith(".")]

"""Recordings of real sensors, frame by frame: Kinect depth of UTD-MHAD, and folders of point clouds.

Depth recordings are in the frame of the sensor: metres, y up, right-handed, the sensor at the origin and looking
along -z.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from ddakf.depth import without_fliers
from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.camera import Camera, Intrinsics
from ddakf.evaluation.depth_template import JUMP, smoothed, template_from_depth
from ddakf.evaluation.sensors import Cloud
from ddakf.io import MESH_SUFFIXES, POINT_SUFFIXES, read_mesh, read_points
from ddakf.mesh import Mesh

MM = 1e-3  # metres
# The Kinect for Windows delivers mirrored images: people's left hands appear on the left. They are mirrored back, and
# with them the principal point (160, 120) that fits the recordings.
KINECT = Intrinsics(width=320, height=240, fx=285.63, fy=285.63, cx=159.0, cy=120.0)
UNREADABLE = (ValueError, OSError, KeyError, TypeError, NotImplementedError, MemoryError, IndexError, MatReadError)


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
        depth: (T, H, W) uint16 millimetres, 0 where nothing was seen.
        camera: in whose world the points are.
        fps: frames per second.
        smooth: even out the sensor's depth steps (22 mm at 2.8 m), which otherwise make every local plane face the
            camera. Tracking without it ends 10-30 % farther from the points as they were measured.
    """

    name: str
    depth: np.ndarray
    camera: Camera
    fps: float
    smooth: bool = True

    def __len__(self) -> int:
        return len(self.depth)

    def timestamp(self, frame: int) -> float:
        """Seconds since frame 0."""
        return frame / self.fps

    def cloud(self, frame: int) -> Cloud:
        """The points of one frame without those that float behind edges, and the camera's position."""
        depth = self.depth[frame] * MM
        if self.smooth:
            depth = smoothed(depth, JUMP, passes=1)
        points = self.camera.unproject(depth, without_fliers(depth, JUMP))
        return Cloud(points.astype(np.float32), self.camera.eye)

    def template(self, frame: int = 0) -> Mesh:
        """Grid mesh of one frame, about 3,000 vertices."""
        return template_from_depth(self.depth[frame] * MM, self.camera)


@dataclass(frozen=True, eq=False)
class FolderRecording:
    """A folder with one file of points per frame, in the order of the numbers in their names; units and axes are
    theirs.

    Attributes:
        name: of the folder.
        paths: of the frames.
        fps: frames per second.
    """

    name: str
    paths: tuple[Path, ...]
    fps: float

    def __len__(self) -> int:
        return len(self.paths)

    def timestamp(self, frame: int) -> float:
        """Seconds since frame 0."""
        return frame / self.fps

    def cloud(self, frame: int) -> Cloud:
        """The points of one frame; where the sensor was is not known."""
        return Cloud(read_points(self.paths[frame]).astype(np.float32), None)

    def template(self, frame: int = 0) -> Mesh:
        """The mesh that a frame's file holds, cleaned.

        Raises:
            InvalidArgument: it holds points only.
        """
        if self.paths[frame].suffix.lower() not in MESH_SUFFIXES:
            raise InvalidArgument("template", "a mesh file, as the frames are points", "none")
        try:
            return Mesh.cleaned(*read_mesh(self.paths[frame]))[0]
        except InvalidFile as error:
            raise InvalidArgument("template", "a mesh file, as the frames are points", "none") from error


def load_depth(path, fps: float = 30.0) -> DepthRecording:
    """Reads a Kinect recording of UTD-MHAD: ``d_depth`` (240, 320, T), millimetres, in a MATLAB file.

    Raises:
        InvalidFile: no such file, no MATLAB file, no ``d_depth`` of that shape.
    """
    path = Path(path)
    if not path.is_file():
        raise InvalidFile(str(path), "a depth recording (.mat)", "nothing there")
    try:
        depth = loadmat(path, variable_names=["d_depth"])["d_depth"]
    except KeyError:
        raise InvalidFile(f"{path.name}: d_depth", "to be in the file", "nothing of that name") from None
    except UNREADABLE as error:
        raise InvalidFile(str(path), "a MATLAB file", f"{type(error).__name__}: {error}") from error
    shape = (KINECT.height, KINECT.width)
    if depth.ndim != 3 or depth.shape[:2] != shape or depth.shape[2] == 0 or depth.dtype.kind not in "uif":
        raise InvalidFile(f"{path.name}: d_depth", f"millimetres of shape {(*shape, 'T')}", f"{depth.dtype} {depth.shape}")
    images = np.clip(np.nan_to_num(depth), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    upright = np.ascontiguousarray(images.transpose(2, 0, 1)[:, :, ::-1])
    return DepthRecording(path.stem, upright, Camera.at_origin(KINECT), _positive_rate(fps))


def load_folder(path, fps: float = 30.0) -> FolderRecording:
    """Opens a folder of .ply, .obj, .xyz, .txt, .csv or .pcd frames, read as they are asked for.

    Raises:
        InvalidFile: no such folder, or no frames in it.
    """
    path = Path(path)
    if not path.is_dir():
        raise InvalidFile(str(path), "a folder of frames", "no folder")
    files = (entry for entry in path.iterdir() if entry.suffix.lower() in POINT_SUFFIXES)
    paths = tuple(sorted(files, key=lambda entry: [int(n) for n in re.findall(r"\d+", entry.name)] or [0]))
    if not paths:
        raise InvalidFile(str(path), f"frames ({', '.join(POINT_SUFFIXES)})", "none in the folder")
    return FolderRecording(path.name, paths, _positive_rate(fps))


def load_recording(path, fps: float = 30.0) -> Recording:
    """A folder of frames, or a depth recording (.mat)."""
    return load_folder(path, fps) if Path(path).is_dir() else load_depth(path, fps)


def _positive_rate(fps: float) -> float:
    if not 0 < fps < np.inf:
        raise InvalidArgument("fps", "a positive number", str(fps))
    return float(fps)

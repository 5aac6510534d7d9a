"""Folders of depth images with intrinsics, as RGB-D recorders write them.

``depth/*.png`` (grey, 16 bit), in the order of the numbers in their names. ``intrinsics.txt`` (a 3 x 3 or 4 x 4 matrix) or
``camera.json``: ``fx, fy, cx, cy``, or Open3D's ``intrinsic_matrix``; optionally ``depth_scale`` (units per metre, default
1000), ``fps``, and ``T_world_sensor`` (4 x 4, camera to world). Optional: ``mask/*.png``, one of the same number for every frame,
not zero on the garment; ``color/*.png`` or ``*.jpg`` of what the pixels of the depth see, left aside unless there is one in red,
green and blue and of the depth's size for every frame; ``timestamps.txt``, seconds, a line per frame. Camera axes: x right, y
down, z forward. Without ``T_world_sensor`` the points are in the axes of the sensor: y up, looking along -z.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence as Ordered
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile
from ddakf.evaluation.datasets.captures.frame_names import beside, in_order
from ddakf.evaluation.datasets.captures.recording import TIMES, DepthRecording, frame_times, positive_rate, rate_of, visible
from ddakf.evaluation.datasets.formats.depth_files import LARGEST, is_number, load_camera, read_colors, read_depth, read_grey

log = logging.getLogger(__name__)

MILLIMETRES = 1000.0  # per metre
LEAST_SCALE = 1.0  # units per metre
COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, eq=False)
class DepthImages(Ordered):
    """Depth images (H, W) in millimetres, read when they are needed.

    Attributes:
        paths: of the images. masks: of the masks, as many or none.
        scale: units of the images per metre.
        shape: (H, W) of all of them.
    """

    paths: tuple[Path, ...]
    masks: tuple[Path, ...]
    scale: float
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, frame: int) -> np.ndarray:
        depth = _as_first(read_depth(self.paths[frame]), self.paths[frame], self.shape)
        if self.masks:
            mask = _as_first(read_grey(self.masks[frame]), self.masks[frame], self.shape)
            depth = np.where(mask > 0, depth, 0)
        return depth if self.scale == MILLIMETRES else (depth * np.float32(MILLIMETRES / self.scale)).astype(np.float32)

@dataclass(frozen=True, eq=False)
class ColorImages(Ordered):
    """Colour images (H, W, 3) uint8, read when they are needed.

    Attributes:
        paths: of the images.
        shape: (H, W) of all of them.
    """

    paths: tuple[Path, ...]
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, frame: int) -> np.ndarray:
        return _as_first(read_colors(self.paths[frame]), self.paths[frame], self.shape)


def _as_first(image: np.ndarray, path: Path, shape: tuple[int, int]) -> np.ndarray:
    """The image of a file, which has this (H, W)."""
    if image.shape[:2] != shape:
        raise InvalidFile(str(path), f"an image of shape {shape} as the first one", str(image.shape[:2]))
    return image


def is_rgbd(path: Path) -> bool:
    """True if a folder holds depth images."""
    return bool(_images(path / "depth", (".png",)))


def load_rgbd(path, fps: float = 30.0) -> DepthRecording:
    """Opens a folder of depth images.

    Args:
        path: the folder.
        fps: frames per second where neither ``camera.json`` nor ``timestamps.txt`` states them.

    Raises:
        InvalidFile: no depth images, no intrinsics, masks or timestamps that do not fit, images that differ in size.
        MissingDependency: Pillow is not installed.
    """
    path = Path(path)
    paths = in_order(_images(path / "depth", (".png",)))
    if not paths:
        raise InvalidFile(str(path), "depth images depth/*.png", "none")
    shape = read_depth(paths[0]).shape
    camera, fields = load_camera(path, shape)
    scale = fields.get("depth_scale", MILLIMETRES)
    if not is_number(scale) or scale < LEAST_SCALE:
        expected = f"units per metre, 1000 for millimetres, in [{LEAST_SCALE:g}, {LARGEST:g}]"
        raise InvalidFile("camera.json: depth_scale", expected, str(scale)[:40])
    images = DepthImages(paths, _masks(path, paths), float(scale), shape)
    times = frame_times(path / TIMES, len(paths))
    fps = rate_of(times, fields.get("fps", fps))
    if not is_number(fps):
        raise InvalidFile("camera.json: fps", "a number", str(fps)[:40])
    colors = _colors(path / "color", paths, shape)
    return DepthRecording(path.resolve().name, images, camera, positive_rate(fps), times=times, colors=colors)


def _masks(path: Path, paths: tuple[Path, ...]) -> tuple[Path, ...]:
    """The mask of every image; empty without a folder ``mask``."""
    if not (path / "mask").is_dir():
        return ()
    found = beside(paths, _images(path / "mask", (".png",)))
    if None in found:
        raise InvalidFile(f"{path.name}/mask", "a mask for every depth image", f"none for {paths[found.index(None)].name}")
    return tuple(found)


def _colors(folder: Path, paths: tuple[Path, ...], shape: tuple[int, int]) -> ColorImages | None:
    """The colours of every image; None where some are missing, or the first ones are of another kind or size."""
    found = beside(paths, _images(folder, COLOR_SUFFIXES))
    if None in found:
        if any(found):
            log.warning("%s is left aside: it has no image for %s", folder.name, paths[found.index(None)].name)
        return None
    try:
        first = read_colors(found[0]).shape[:2]
    except InvalidFile as error:
        log.warning("%s is left aside: %s", folder.name, error)
        return None
    if first != shape:
        log.warning("%s is left aside: %s is %d x %d, not %d x %d as the depth", folder.name, found[0].name, *first, *shape)
        return None
    return ColorImages(tuple(found), shape)


def _images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return [path for path in visible(folder.glob("*")) if path.suffix.lower() in suffixes]

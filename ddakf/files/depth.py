"""Depth images of a pinhole camera: which pixels to believe, and where they are in the world. H rows, W columns.

The centre of the pixel in row v and column u is at (u, v). A depth is the z coordinate in camera axes (x right, y down, z
forward), not the length of the ray; one that is not positive or not finite is no measurement.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# A line between two pixels that the sight meets at less than 10 degrees is an edge between two surfaces, not a slope: the filter
# of jump edges of May et al. 2009, "Three-dimensional mapping with time-of-flight cameras", J. Field Robotics 26, section 3.
STEEPEST = np.tan(np.deg2rad(80.0))
# Axial noise of a Kinect, m, of depth z: Nguyen, Izadi and Lovell 2012, "Modeling Kinect sensor noise for improved 3D
# reconstruction and tracking", equation (2). Other depth cameras are better.
NOISE_NEAR, NOISE_FAR, NOISE_LEAST_AT = 0.0012, 0.0019, 0.4
NOISE_SDS = 3.0  # of the difference of two pixels


class Intrinsics(NamedTuple):
    """Focal lengths and principal point, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


def seen(depth: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels with a measurement."""
    return np.isfinite(depth) & (depth > 0)


def largest_step(depth: np.ndarray, focal: float) -> np.ndarray:
    """(H, W) metres by which a pixel may lie behind a neighbour on the same surface: the steepest slope, and noise.

    Neighbours up to a diagonal apart, sqrt(2) z / f, on a surface whose normal is 80 degrees off the line of sight.

    Args:
        depth: (H, W) metres.
        focal: length, pixels; the shorter one where there are two.
    """
    noise = NOISE_NEAR + NOISE_FAR * np.square(depth - NOISE_LEAST_AT)
    return np.sqrt(2.0) * (STEEPEST / focal * depth + NOISE_SDS * noise)


def without_fliers(depth: np.ndarray, jump: float | np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels no farther than ``jump`` metres behind the nearest of their eight neighbours.

    At the edge of an object a depth camera mixes foreground and background; such points float behind the edge.

    Args:
        depth: (H, W) metres; not positive, or not finite, where nothing was seen.
        jump: one for all, or (H, W).
    """
    mask = seen(depth)
    z = np.where(mask, depth, np.inf)
    padded = np.pad(z, 1, constant_values=np.inf)
    rows = np.minimum(np.minimum(padded[:-2], padded[1:-1]), padded[2:])
    nearest = np.minimum(np.minimum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])
    return mask & (z < nearest + jump)


def unproject(depth: np.ndarray, keep: np.ndarray, lens: Intrinsics, pose: np.ndarray) -> np.ndarray:
    """(N, 3) float64 world points of the pixels to ``keep``, row by row, metres.

    Args:
        depth: (H, W) metres.
        keep: (H, W) bool, all of them with a measurement.
        lens: of the camera.
        pose: (3, 4) [R | t], camera axes to world, metres.
    """
    v, u = np.nonzero(keep)
    z = depth[v, u].astype(np.float64)
    inside = np.column_stack([(u - lens.cx) / lens.fx * z, (v - lens.cy) / lens.fy * z, z])
    return inside @ pose[:, :3].T + pose[:, 3]

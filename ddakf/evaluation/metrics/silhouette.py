"""Silhouettes: agreement of the outlines of two poses of a garment from cameras all around, or with a measured one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.evaluation.sensors.camera import Camera, Intrinsics

CAMERAS = 4  # at equal angles about the vertical, the first one on the side of +z
DISTANCE = 2.0  # m, horizontally from the truth's centroid
# 7 mm per pixel there, and a picture of 2.2 m: a person in motion is in it whole
INTRINSICS = Intrinsics(width=320, height=320, fx=285.0, fy=285.0, cx=159.5, cy=159.5)


def silhouette_cameras(truth: np.ndarray) -> list[Camera]:
    """The cameras of a frame. They follow the truth, since a garment may leave the view of fixed ones.

    Args:
        truth: (V, 3) metres, y up.
    """
    centre = np.asarray(truth, np.float64).mean(axis=0)
    angles = np.arange(CAMERAS) * 2 * np.pi / CAMERAS
    eyes = centre + DISTANCE * np.column_stack([np.sin(angles), np.zeros(CAMERAS), np.cos(angles)])
    return [Camera.looking_at(INTRINSICS, eye, centre) for eye in eyes]


def silhouette_iou(estimate: np.ndarray, truth: np.ndarray, faces: np.ndarray) -> float:
    """Mean over :func:`silhouette_cameras` of |S_E and S_T| / |S_E or S_T|, with S the pixels whose centre a face covers.

    Args:
        estimate, truth: (V, 3) metres, y up.
        faces: (F, 3). The garment alone is drawn, both sides, without the body.

    Returns:
        In [0, 1]; NaN where no camera sees anything of either, or where a vertex is not finite.
    """
    if not (np.isfinite(estimate).all() and np.isfinite(truth).all()):
        return float("nan")
    shares = []
    for camera in silhouette_cameras(truth):
        one, other = (camera.silhouette(vertices, faces) for vertices in (estimate, truth))
        union = np.count_nonzero(one | other)
        if union:
            shares.append(np.count_nonzero(one & other) / union)
    return float(np.mean(shares)) if shares else float("nan")


class Overlap(NamedTuple):
    """Agreement of a drawn silhouette with a measured one, both ways."""

    iou: float  # |drawn and measured| / |drawn or measured|
    covered: float  # share of the measured pixels that are drawn
    inside: float  # share of the drawn pixels that are measured


def silhouette_overlap(drawn: np.ndarray, measured: np.ndarray) -> Overlap:
    """Overlap of two silhouettes, (H, W) bool each; NaN where there is nothing to share."""
    both, either = np.count_nonzero(drawn & measured), np.count_nonzero(drawn | measured)
    wholes = (either, np.count_nonzero(measured), np.count_nonzero(drawn))
    return Overlap(*(both / whole if whole else float("nan") for whole in wholes))

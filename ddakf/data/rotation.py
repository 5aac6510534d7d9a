"""Rotation: matrices of rotation vectors."""

from __future__ import annotations

import numpy as np

SMALL_ANGLE = 1e-3  # rad, below which a series replaces sin(a / 2) / a


def rotation_matrices(vectors: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation matrices of rotation vectors (..., 3) in radians, through quaternions."""
    vectors = np.asarray(vectors, np.float64)
    angle = np.sqrt(np.square(vectors).sum(axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        half_sine = np.where(angle <= SMALL_ANGLE, 0.5 - angle**2 / 48 + angle**2 * angle**2 / 3840, np.sin(angle / 2) / angle)
    x, y, z = np.moveaxis(half_sine[..., None] * vectors, -1, 0)
    w = np.cos(angle / 2)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    rows = (
        (xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

"""Errors of a real depth camera, applied to an ideal depth image (H, W), metres; infinity or 0 marks pixels without a depth.

Errors of a sensor that triangulates grow with the square of the depth. Of the first Kinect, standard deviation 1.43 mm and steps
of 2.85 mm at 1 m: Khoshelham and Elberink 2012, "Accuracy and resolution of Kinect depth data", Sensors 12(2), section 4.2.
"""

from __future__ import annotations

import numpy as np

from ddakf.files.depth import seen


def mixed_at_edges(depth: np.ndarray, share: float, jump: float, background: float, rng: np.random.Generator) -> np.ndarray:
    """Edge fliers: pixels on the near side of an edge whose depth is a mixture of both sides.

    Args:
        depth: image.
        share: of the edge pixels: those with one of their eight neighbours more than ``jump`` behind them.
        jump: metres.
        background: depth of the wall behind all surfaces, metres.
        rng: chooses the pixels, and their mixtures, uniform between both sides.
    """
    found = seen(depth)
    filled = np.where(found, depth, background)
    padded = np.pad(filled, 1, mode="edge")
    rows = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    behind = np.maximum(np.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]) - filled
    mixed = found & (behind > jump) & (rng.random(depth.shape) < share)
    return np.where(mixed, filled + rng.random(depth.shape) * behind, depth)


def with_axial_noise(depth: np.ndarray, sd: float, rng: np.random.Generator) -> np.ndarray:
    """Gaussian noise along the optical axis of standard deviation ``sd`` z^2 at depth z; ``sd`` in metres at 1 m."""
    found = seen(depth)
    z = np.where(found, depth, 0.0)
    return np.where(found, z + sd * z**2 * rng.normal(size=depth.shape), depth)


def quantised(depth: np.ndarray, step: float) -> np.ndarray:
    """Depths whose inverse is a whole multiple of ``step``: at depth z, metres, they are about ``step`` z^2 apart."""
    found = seen(depth)
    disparity = np.maximum(np.rint(1.0 / (step * np.where(found, depth, 1.0))), 1.0)
    return np.where(found, 1.0 / (step * disparity), depth)

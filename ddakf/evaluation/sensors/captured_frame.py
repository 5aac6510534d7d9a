"""Captured frames: the cloud of one instant, its sensor, and the truth if known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np


class Cloud(NamedTuple):
    """One frame of a sensor."""

    points: np.ndarray  # (N, 3) float32, m
    sensor_origin: np.ndarray | None  # (3,), or (N, 3) for several cameras, m; None when it has none


class ColouredCloud(NamedTuple):
    """One frame of a sensor that sees colours."""

    points: np.ndarray  # (N, 3) float32, m
    sensor_origin: np.ndarray | None  # as in Cloud
    colors: np.ndarray  # (N, 3) uint8, red, green, blue


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """One frame for a tracker, with the truth if known.

    Attributes:
        number: in the recording.
        timestamp: seconds.
        points: (N, 3) float32, metres.
        sensor_origin: (3,), (N, 3) or None, metres.
        body_vertices: (B, 3) for the tracker, or None.
        truth: (V, 3) true garment, or None.
        body: (B, 3) true body, even if the tracker does not get it, or None.
        colors: (N, 3) uint8, red, green and blue of the points, or None.
    """

    number: int
    timestamp: float
    points: np.ndarray
    sensor_origin: np.ndarray | None = None
    body_vertices: np.ndarray | None = None
    truth: np.ndarray | None = None
    body: np.ndarray | None = None
    colors: np.ndarray | None = None

    def copy(self) -> CapturedFrame:
        """The frame with arrays of its own of what a tracker gets, which may change them."""
        given = ("points", "sensor_origin", "body_vertices", "colors")
        return replace(self, **{name: None if (array := getattr(self, name)) is None else array.copy() for name in given})

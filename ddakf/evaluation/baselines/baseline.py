"""Baseline: the interface of the methods that the tracker is compared with."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh


class Baseline(Protocol):
    """A method that tracks a garment through point clouds, with any state between frames."""

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """Starts a new run.

        Args:
            garment: its vertices are the rest shape.
            vertices: (V, 3) of the garment before the first frame, metres.
            body: in the pose of the start, or None; methods without a body ignore it.

        Raises:
            NotApplicable: it cannot be used here; the message has the reason.
        """

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """Tracks one frame, of which the method may use the points, their sensor's origin, the time and the body's vertices.

        Returns:
            (V, 3) the garment in this frame, metres.

        Raises:
            NotApplicable: the frame lacks data that the method needs.
        """

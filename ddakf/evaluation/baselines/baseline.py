"""Baseline: the interface of the methods that the tracker is compared with."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh


class Baseline(Protocol):
    """A method that follows a garment through point clouds; what it keeps between frames is its own affair."""

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """Starts anew.

        Args:
            garment: its vertices are the rest shape.
            vertices: (V, 3) where the garment is before the first frame, metres.
            body: in the pose of the start, or None; what knows no body ignores it.

        Raises:
            NotApplicable: it cannot be used here; the sentence says what it lacks.
        """

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """One frame, of which the method sees the points, their sensor's place, the time and the body's vertices.

        Returns:
            (V, 3) the garment in this frame, metres.

        Raises:
            NotApplicable: this frame lacks what the method cannot do without.
        """

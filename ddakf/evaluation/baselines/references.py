"""References: rows of every table that use no cloud, below which a tracker brings nothing."""

from __future__ import annotations

import numpy as np

from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh


class Still:
    """The garment of the start, in every frame."""

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        self._vertices = np.array(vertices, np.float64)

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        return self._vertices.copy()

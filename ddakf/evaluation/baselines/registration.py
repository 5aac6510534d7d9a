"""Registration: base class of the baselines without memory, which know only where the last frame ended."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from ddakf.evaluation.baselines.body_support import HOLD, support_of
from ddakf.evaluation.baselines.matching import LEAST_POINTS, VertexNormals
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh


class Registration(ABC):
    """Moves the garment from its last place onto each cloud. A cloud of too few points leaves it there. Uses no time.

    A body carries the last place on, and nothing stays inside it; see :mod:`.body_support`.
    """

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        self._garment, self._position = garment, np.array(vertices, np.float64)
        self._normals = VertexNormals(garment)
        self._support = support_of(body, self._position, self.hold)

    @property
    def hold(self) -> float:
        """Weight of hidden vertices on the body."""
        return HOLD

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        self._position = self._support.begin(frame, self._position)
        if len(frame.points) >= LEAST_POINTS:
            self._position = self._registered(self._position, frame)
        self._position = self._support.outside(self._position)
        return self._position.copy()

    @abstractmethod
    def _registered(self, x: np.ndarray, frame: CapturedFrame) -> np.ndarray:
        """(V, 3) the garment, so far at x (V, 3), laid onto the frame's points."""

"""ClothFit as a baseline: skinning moves the garment with the body, and networks add an offset. It never uses the cloud."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from ddakf.errors import NotApplicable
from ddakf.evaluation.baselines.clothfit.features import Features
from ddakf.evaluation.baselines.clothfit.network import Committee
from ddakf.evaluation.baselines.clothfit.settings import TUNED, AnswerSettings
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

NO_BODY = "clothfit moves the garment by the body alone, and no body is given"


class ClothFit:
    """Pose-conditioned deformation, learned: see docs/baselines.md.

    Args:
        committee: returns the networks, see :mod:`.network`; called at a start with a body, as it may train them.
        settings: of the training and of the use of their answers.
    """

    def __init__(self, committee: Callable[[], Committee], settings: AnswerSettings = TUNED):
        self._ask, self.settings = committee, settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`.

        Raises:
            NotApplicable: no body, or no networks.
        """
        if body is None:
            raise NotApplicable(NO_BODY)
        self._committee = self._ask()
        self._features, self._average = Features(garment, vertices, body), _average(garment)

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`.

        Raises:
            NotApplicable: no body in this frame.
        """
        if frame.body_vertices is None:
            raise NotApplicable(NO_BODY)
        inputs = self._features.step(frame.body_vertices, frame.timestamp)
        offset = np.einsum("qab,qb->qa", inputs.rotation, self._committee.offsets(inputs, self.settings))
        for _ in range(self.settings.smoothing):
            offset = self._average @ offset
        return inputs.carried + offset


def _average(garment: Mesh) -> sparse.csr_array:
    """(V, V) half of a vertex and half of the mean of its neighbours."""
    n, (i, j) = garment.n_vertices, garment.edges.T
    adjacency = sparse.csr_array((np.ones(2 * len(i)), (np.concatenate([i, j]), np.concatenate([j, i]))), (n, n))
    return 0.5 * (sparse.eye_array(n) + sparse.diags_array(1 / adjacency.sum(axis=1)) @ adjacency).tocsr()

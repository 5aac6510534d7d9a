"""ClothFit at work: the garment rides on the body, and the networks say what it does beyond that. It never sees the cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from ddakf.errors import NotApplicable
from ddakf.evaluation.baselines.clothfit.features import Features
from ddakf.evaluation.baselines.clothfit.network import Committee
from ddakf.mesh import Mesh

if TYPE_CHECKING:
    from ddakf.evaluation.source import Frame

SMOOTHING = 2  # averages of an offset with its neighbours'
NO_BODY = "clothfit moves the garment by the body alone, and no body is given"


class ClothFit:
    """Pose-conditioned deformation, learned: see docs/baselines.md.

    Args:
        committee: see :mod:`.network`; of :func:`.weights.committee` or your own.
    """

    def __init__(self, committee: Committee):
        self._committee = committee

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.Baseline`.

        Raises:
            NotApplicable: no body.
        """
        if body is None:
            raise NotApplicable(NO_BODY)
        self._features, self._average = Features(garment, vertices, body), _average(garment)

    def step(self, frame: Frame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.Baseline`.

        Raises:
            NotApplicable: no body in this frame.
        """
        if frame.body_vertices is None:
            raise NotApplicable(NO_BODY)
        inputs = self._features.step(frame.body_vertices, frame.timestamp)
        offset = np.einsum("qab,qb->qa", inputs.rotation, self._committee.offsets(inputs))
        for _ in range(SMOOTHING):
            offset = self._average @ offset
        return inputs.carried + offset


def _average(garment: Mesh) -> sparse.csr_array:
    """(V, V) half of a vertex and half of the mean of its neighbours."""
    n, (i, j) = garment.n_vertices, garment.edges.T
    adjacency = sparse.csr_array((np.ones(2 * len(i)), (np.concatenate([i, j]), np.concatenate([j, i]))), (n, n))
    return 0.5 * (sparse.eye_array(n) + sparse.diags_array(1 / adjacency.sum(axis=1)) @ adjacency).tocsr()

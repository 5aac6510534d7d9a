"""Hidden cloth of a garment without a body: it follows the seen cloth near it (with stage H, not in the paper).

Elastic forces carry the motion of seen cloth to hidden cloth by the edge of what is seen, and that edge is measured worst: planes
at a silhouette are few and oblique. The rigid motion of all seen cloth around a place, since the track started, is a second
estimate of where hidden cloth is. It errs in another way, so that a mean of both errs less than either.
"""

from __future__ import annotations

from math import exp

import numpy as np

from ddakf.kernels import hidden_cloth as kernels
from ddakf.kernels.cluster_alignment import centers
from ddakf.kernels.rigid_motion import moments
from ddakf.stages.error_size import along_cloth
from ddakf.types import Estimate, Posterior, Problem

# Shares of the vertices that are seen, and how far hidden cloth then follows: of little cloth no motion is known; of much, hidden
# cloth has seen cloth on all sides. In between it fades, so that nothing jumps.
SEEN, FOLLOWED = (0.02, 0.04, 0.5, 0.7), (0.0, 1.0, 1.0, 0.0)
FARTHEST = 1e-6  # weight of seen cloth at any distance: where none is near, all of it counts


def follow_seen(problem: Problem, estimate: Estimate, posterior: Posterior) -> tuple[Posterior, np.ndarray | None]:
    """The posterior whose hidden cloth is drawn to where the seen cloth carries it, and by how much it is shown nearer still.

    The state moves slowly, with time constant ``time``: it keeps what the forces say. What is shown is a mean of both estimates.

    Returns:
        The posterior; (V, 3) metres to add to its positions in the result, or None: too much is seen, or never was enough, or a
        body tells where hidden cloth is. In frames that show too little what was added fades.
    """
    config, seen, model = problem.config.follow, estimate.learnable, problem.model
    if config.reach == 0 or problem.body is not None or problem.health.state in ("initializing", "lost"):
        return posterior, None
    share = seen.mean()
    followed = np.interp(share, SEEN, FOLLOWED)
    if problem.health.unplaced or share <= SEEN[0]:
        last = problem.last.offset
        return posterior, None if last is None else exp(-problem.dt / config.time) * last
    if followed == 0:
        return posterior, None
    state = posterior.state
    away = followed * (1.0 - np.exp(-along_cloth(seen, model) / config.onset))
    # a copy, as the mesh's are read-only, which is another type for kernels
    start = model.mesh.vertices.copy() if problem.resting is None else problem.resting.position
    motion, offset = _motions(start, state.position, seen, problem), np.empty(state.position.shape)
    kernels.offsets(start, state.position, (model.clusters.nearest, model.clusters.share), motion, away, offset)
    drawn = 1.0 - exp(-problem.dt / config.time)
    state = state._replace(position=state.position + drawn * offset)
    return posterior._replace(state=state), config.share * (1.0 - drawn) * offset


def _motions(start: np.ndarray, position: np.ndarray, seen: np.ndarray, problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """(K, 3, 3) rotations and (K, 3) translations since the start, of the seen cloth around each cluster (Kabsch 1976)."""
    model, center = problem.model, np.empty((problem.model.n_clusters, 3))
    centers(start, model.cluster, center)
    gaps = np.square(center[:, None] - center[None]).sum(axis=2)
    near = np.exp(-0.5 * gaps / problem.config.follow.reach**2) + FARTHEST
    of_cluster = np.empty((len(center), 16))
    moments(start, position, seen, model.cluster, of_cluster)
    sums = near @ of_cluster
    before, now = sums[:, 1:4] / sums[:, :1], sums[:, 4:7] / sums[:, :1]
    covariance = sums[:, 7:].reshape(-1, 3, 3) / sums[:, :1, None] - before[:, :, None] * now[:, None, :]
    left, _, right = np.linalg.svd(covariance)
    right[:, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    rotation = (left @ right).transpose(0, 2, 1)
    return rotation, now - np.einsum("kab,kb->ka", rotation, before)

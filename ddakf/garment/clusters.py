"""Clusters of a garment: pieces of vertices that move rigidly in cluster alignment, and the seams between them."""

from __future__ import annotations

import numpy as np

from ddakf.config import Discretisation
from ddakf.kernels.cluster_alignment import Elimination
from ddakf.mesh import Mesh
from ddakf.types import Clusters


def build(mesh: Mesh, distance: np.ndarray, ends: np.ndarray, config: Discretisation) -> Clusters:
    """Clusters around seed vertices.

    Args:
        mesh: the garment at rest.
        distance: (K, V) along the surface from each seed, metres; infinite from another piece of the garment.
        ends: (2E, 2) vertices of each entry of the one-rings.
        config: number of blended clusters and of measured vertices.
    """
    n, k = mesh.n_vertices, len(distance)
    followed = min(config.followed_clusters, k)
    order = np.argsort(distance, axis=0, kind="stable")
    nearest = order[:followed].T
    near = np.take_along_axis(distance.T, nearest, axis=1)
    # weights fall to zero at the first seed that is not blended, so that no vertex jumps where the set of seeds changes
    reach = np.take_along_axis(distance, order[followed][None], axis=0)[0] if k > followed else 2.0 * near[:, -1]
    reach = np.where(np.isfinite(reach), reach, 2.0 * near[:, 0])
    # a piece of the garment without a seed has no neighbour: all of it follows the first cluster
    lonely = ~np.isfinite(near[:, 0])
    near[lonely], reach[lonely] = np.inf, 1.0
    share = np.square(np.maximum(1.0 - near / (reach + 1e-6)[:, None], 0.0))
    share[:, 0] += 1e-6
    cluster = nearest[:, 0]
    across = np.flatnonzero((cluster[ends[:, 0]] != cluster[ends[:, 1]]) & (ends[:, 0] < ends[:, 1]))
    across = across[np.lexsort(cluster[ends[across]].T)]  # those of the same two clusters together
    seam = np.column_stack([ends[across], across]).astype(np.int32)
    sample = np.lexsort((near[:, 0], cluster))[:: max(1, n // config.cluster_samples)].astype(np.int32)
    neighbours = np.unique(np.concatenate([cluster[seam[:, :2]], cluster[seam[:, 1::-1]]]), axis=0).astype(np.int32)
    return Clusters(
        nearest.astype(np.int32),
        share / share.sum(axis=1, keepdims=True),
        seam,
        neighbours,
        elimination(neighbours, k),
        _weakening(mesh.vertices, cluster, ends, seam),
        np.sort(sample),
        np.sort(sample[:: config.probe_stride]),
    )


def elimination(ends: np.ndarray, k: int) -> Elimination:
    """Reverse Cuthill-McKee order of the clusters: level by level away from one at an end, those of few neighbours first.

    Args:
        ends: (G, 2) neighbouring clusters, both ways.
        k: number of clusters.
    """
    near = [ends[ends[:, 0] == c, 1] for c in range(k)]
    degree = np.array([len(found) for found in near])
    order: list[int] = []
    while len(order) < k:
        rest = np.setdiff1d(np.arange(k), order)
        begin = int(rest[degree[rest].argmin()])
        order += _levels(near, degree, _levels(near, degree, begin)[-1])
    order.reverse()
    place = np.argsort(order)
    first = np.array([min(place[near[c]].min(initial=k), place[c]) for c in order])
    return Elimination(np.array(order, np.int32), first.astype(np.int32), int(6 * (np.arange(k) - first + 1).max()))


def _levels(near: list[np.ndarray], degree: np.ndarray, begin: int) -> list[int]:
    """The clusters that are connected with ``begin``, in the order of a breadth-first search."""
    order, seen = [begin], {begin}
    for cluster in order:
        new = [int(other) for other in near[cluster] if int(other) not in seen]
        order += sorted(new, key=lambda other: (degree[other], other))
        seen.update(new)
    return order


def _weakening(vertices: np.ndarray, cluster: np.ndarray, ends: np.ndarray, seam: np.ndarray) -> float:
    """Energy of a uniform strain over all edges, divided by its approximation with rigid clusters.

    Rigid clusters put the whole strain into the seams (over-correction of piecewise constant coarse spaces, Braess 1995,
    "Towards algebraic multigrid for elliptic problems of second order").
    """
    size = np.bincount(cluster)
    centre = np.column_stack([np.bincount(cluster, vertices[:, a]) for a in range(3)]) / np.maximum(size, 1)[:, None]
    fine = 0.5 * np.square(vertices[ends[:, 1]] - vertices[ends[:, 0]]).sum()
    rigid = np.square(centre[cluster[seam[:, 1]]] - centre[cluster[seam[:, 0]]]).sum()
    return float(min(1.0, fine / rigid)) if rigid > 0 else 1.0

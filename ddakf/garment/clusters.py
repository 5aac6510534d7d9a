"""The coarse level of a garment: clusters of vertices that move rigidly, and the seams between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.mesh import Mesh

FOLLOWED = 4  # clusters that a vertex follows
SAMPLES = 1200  # vertices that are measured at the coarse level
PROBED = 4  # of so many of them one tells whether coarse passes are made


class Clusters(NamedTuple):
    """K clusters of a garment's V vertices."""

    nearest: np.ndarray  # (V, N) int32 clusters that a vertex follows
    share: np.ndarray  # (V, N) by how much, rows sum to one
    seam: np.ndarray  # (C, 3) int32 edges between two clusters: vertices i and j, and the entry i to j of the one-rings
    ends: np.ndarray  # (G, 2) int32 clusters that touch, both ways
    weakening: float  # of the seams' stiffness: share of the energy of a uniform strain that they overstate
    sample: np.ndarray  # (S,) int32 vertices that are measured
    probe: np.ndarray  # (S / PROBED,) int32 of them, those that are measured first


def build(mesh: Mesh, distance: np.ndarray, ends: np.ndarray) -> Clusters:
    """The clusters around seeds.

    Args:
        mesh: the garment at rest.
        distance: (K, V) along the surface from each seed, metres; infinite where there is no way.
        ends: (2E, 2) vertices of each entry of the one-rings.
    """
    n, k = mesh.n_vertices, len(distance)
    followed = min(FOLLOWED, k)
    order = np.argsort(distance, axis=0, kind="stable")
    nearest = order[:followed].T
    near = np.take_along_axis(distance.T, nearest, axis=1)
    # falls to zero at the first seed that is not followed, so that no vertex jumps where that changes
    reach = np.take_along_axis(distance, order[followed][None], axis=0)[0] if k > followed else 2.0 * near[:, -1]
    reach = np.where(np.isfinite(reach), reach, 2.0 * near[:, 0])
    # a piece of the garment without a seed is nobody's neighbour: it follows the first cluster, all of it alike
    lonely = ~np.isfinite(near[:, 0])
    near[lonely], reach[lonely] = np.inf, 1.0
    share = np.square(np.maximum(1.0 - near / (reach + 1e-6)[:, None], 0.0))
    share[:, 0] += 1e-6
    cluster = nearest[:, 0]
    across = np.flatnonzero((cluster[ends[:, 0]] != cluster[ends[:, 1]]) & (ends[:, 0] < ends[:, 1]))
    seam = np.column_stack([ends[across], across]).astype(np.int32)
    sample = np.lexsort((near[:, 0], cluster))[:: max(1, n // SAMPLES)].astype(np.int32)
    return Clusters(
        nearest.astype(np.int32),
        share / share.sum(axis=1, keepdims=True),
        seam,
        np.unique(np.concatenate([cluster[seam[:, :2]], cluster[seam[:, 1::-1]]]), axis=0).astype(np.int32),
        _weakening(mesh.vertices, cluster, ends, seam),
        np.sort(sample),
        np.sort(sample[::PROBED]),
    )


def _weakening(vertices: np.ndarray, cluster: np.ndarray, ends: np.ndarray, seam: np.ndarray) -> float:
    """Energy of a uniform strain over all edges, over that of its approximation by clusters that keep their shape.

    Rigid clusters put the whole strain into the seams (over-correction of piecewise constant coarse spaces, Braess 1995,
    "Towards algebraic multigrid for elliptic problems of second order").
    """
    size = np.bincount(cluster)
    centre = np.column_stack([np.bincount(cluster, vertices[:, a]) for a in range(3)]) / np.maximum(size, 1)[:, None]
    fine = 0.5 * np.square(vertices[ends[:, 1]] - vertices[ends[:, 0]]).sum()
    coarse = np.square(centre[cluster[seam[:, 1]]] - centre[cluster[seam[:, 0]]]).sum()
    return float(min(1.0, fine / coarse)) if coarse > 0 else 1.0

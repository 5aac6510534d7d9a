"""Stage G, reliability (paper, section 2.6): offset of the cloud from the surface, strain, innovations and variances."""

from math import sqrt

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def squared_offset(points, position, nearest, distance, longest, excluded, cluster, n_clusters):
    """Squared mean offset of points from a surface, cluster by cluster, so that noise cancels out.

    Each point belongs to the vertex nearest to it. With d_i the offsets of the n points of a cluster,
    (|sum d|^2 - sum |d|^2) / (n (n - 1)) has the squared mean offset as its expectation, however noisy the points are.

    Args:
        points: (N, 3) metres.
        position: (V, 3) the fitted vertices, metres.
        nearest, distance: (N,) of :func:`nearest_vertices`.
        longest: metres: points farther away do not count.
        excluded: (V,) bool, vertices whose points do not count.
        cluster: (V,) int32 in [0, n_clusters).
        n_clusters: number of the clusters.

    Returns:
        Squared mean offset over the clusters, square metres; zero where no cluster has two points.
    """
    count, square, total = np.zeros(n_clusters), np.zeros(n_clusters), np.zeros((n_clusters, 3))
    for k in range(points.shape[0]):
        v = nearest[k]
        if v < 0 or excluded[v] or distance[k] > longest:
            continue
        c = cluster[v]
        count[c] += 1.0
        square[c] += distance[k] ** 2
        for a in range(3):
            total[c, a] += points[k, a] - position[v, a]
    pairs = offset = 0.0
    for c in range(n_clusters):
        pairs += count[c] * (count[c] - 1.0)
        offset += total[c, 0] ** 2 + total[c, 1] ** 2 + total[c, 2] ** 2 - square[c]
    return max(offset / pairs, 0.0) if pairs > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def strains(position, start, neighbour, rest_length, squared):
    """Mean squared strain (|x_j - x_i| / rest length - 1)^2 over the 2E entries of the one-rings.

    Args:
        position: (V, 3) metres.
        start, neighbour: one-rings in compressed rows.
        rest_length: (2E,) metres.
        squared: (V,) out, mean squared strain of each ring.
    """
    squared[:] = 0.0
    for i in range(position.shape[0]):
        x, y, z, ring = position[i, 0], position[i, 1], position[i, 2], 0.0
        for k in range(start[i + 1] - 1, start[i] - 1, -1):
            j = neighbour[k]
            if j < i:  # ascending: the edges to smaller vertices were added from there
                break
            length = sqrt((position[j, 0] - x) ** 2 + (position[j, 1] - y) ** 2 + (position[j, 2] - z) ** 2)
            strain = length / max(rest_length[k], 1e-15) - 1.0
            ring += strain * strain
            squared[j] += strain * strain
        squared[i] += ring
    total = squared.sum()
    for i in range(position.shape[0]):
        squared[i] /= max(start[i + 1] - start[i], 1)
    return total / max(len(neighbour), 1)


@njit(nogil=True, cache=True, error_model="numpy")
def squared_innovations(innovation, R, found):
    """Sum of |y|^2 / trace(R) over the ``found`` (V,) of (V, 3) innovations and (V, 3, 3) covariances."""
    total = 0.0
    for i in range(innovation.shape[0]):
        if found[i]:
            y = innovation[i]
            total += (y[0] * y[0] + y[1] * y[1] + y[2] * y[2]) / (R[i, 0, 0] + R[i, 1, 1] + R[i, 2, 2])
    return total

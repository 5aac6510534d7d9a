"""Hidden cloth: the places to which the rigid motions of the seen cloth carry the vertices."""

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def offsets(start, position, clusters, motion, share, offset):
    """By how much vertices are off the places to which the blend of the clusters' motions carries them, times a share.

    Args:
        start: (V, 3) metres, places where the track started.
        position: (V, 3) metres, places now.
        clusters: (V, N) that a vertex follows, and (V, N) by how much; rows of these sum to one.
        motion: (K, 3, 3) rotations and (K, 3) translations of the clusters.
        share: (V,) in [0, 1]; 0: the vertex stays.
        offset: (V, 3) out, metres.
    """
    nearest, weight = clusters
    rotation, translation = motion
    for i in range(position.shape[0]):
        for a in range(3):
            offset[i, a] = 0.0
        if share[i] > 0.0:
            for m in range(nearest.shape[1]):
                p, w = nearest[i, m], weight[i, m] * share[i]
                for a in range(3):
                    R = rotation[p, a]
                    x = R[0] * start[i, 0] + R[1] * start[i, 1] + R[2] * start[i, 2] + translation[p, a]
                    offset[i, a] += w * (x - position[i, a])

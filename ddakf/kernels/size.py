"""Stage E, size: strain that the whole garment shows in the coordinates of its template."""

import numpy as np
from numba import njit

SOFTNESS = 0.1  # strain of an edge that counts by half


@njit(nogil=True, cache=True, error_model="numpy")
def accumulate(position, measured, rings, stride, rest_edge, rest_length, matrix, vector):
    """Adds the normal equations of d' E d = |x_j - x_i| / rest length - 1 over edges whose ends are both measured.

    The six unknowns are E_xx, E_yy, E_zz, E_xy, E_xz, E_yz. An edge weighs 1 / (1 + (strain / SOFTNESS)^2).

    Args:
        position: (V, 3) metres.
        measured: (V,) bool.
        rings: start and neighbour, the one-rings in compressed rows.
        stride: of the vertices whose edges to later ones are looked at.
        rest_edge: (2E, 3) metres, in the template; d is its direction.
        rest_length: (2E,) metres, of the shape at rest.
        matrix: (6, 6) in and out, its lower triangle.
        vector: (6,) in and out.

    Returns:
        Number of these edges, and of those that were looked at.
    """
    (start, neighbour), n, looked, d = rings, 0, 0, np.empty(6)
    for i in range(0, position.shape[0], stride):
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            looked += int(j > i)
            if j <= i or not measured[i] or not measured[j]:
                continue
            length2 = edge2 = 0.0
            for a in range(3):
                length2 += (position[j, a] - position[i, a]) ** 2
                edge2 += rest_edge[e, a] ** 2
            strain, s = np.sqrt(length2) / max(rest_length[e], 1e-15) - 1.0, 1.0 / max(edge2, 1e-30)
            x, y, z = rest_edge[e, 0], rest_edge[e, 1], rest_edge[e, 2]
            d[0], d[1], d[2], d[3], d[4], d[5] = x * x * s, y * y * s, z * z * s, 2 * x * y * s, 2 * x * z * s, 2 * y * z * s
            w = 1.0 / (1.0 + (strain / SOFTNESS) ** 2)
            for a in range(6):
                vector[a] += w * strain * d[a]
                for b in range(a + 1):
                    matrix[a, b] += w * d[a] * d[b]
            n += 1
    return n, looked

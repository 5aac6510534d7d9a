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


@njit(nogil=True, cache=True, error_model="numpy")
def accumulate_hems(vertex, rest, rotation, direction, offset, weight, matrix, vector):
    """Adds the normal equations of strain c . (t - t_mean) + c . shift = offset over hems, c their outward direction at rest.

    The four unknowns are the strain and the shift (m). All sums are divided by the sum of the weights.

    Args:
        vertex: (H,) of the boundary.
        rest: t (V, 3) metres.
        rotation: (V, 3, 3) of the one-rings against the shape at rest.
        direction: (H, 3) unit, outward.
        offset: (H,) metres, from the vertex to the end of the cloud.
        weight: (H,).
        matrix: (4, 4) in and out.
        vector: (4,) in and out.

    Returns:
        Number of hems with a weight, and the mean square of their offsets, m^2.
    """
    n, total, square, row, mean = 0, 0.0, 0.0, np.empty(4), np.zeros(3)
    for h in range(vertex.shape[0]):
        n += int(weight[h] > 0.0)
        total += weight[h]
        for a in range(3):
            mean[a] += weight[h] * rest[vertex[h], a]
    if n == 0:
        return 0, 0.0
    for h in range(vertex.shape[0]):
        if weight[h] <= 0.0:
            continue
        i, share, row[0] = vertex[h], weight[h] / total, 0.0
        for a in range(3):
            row[a + 1] = 0.0
            for b in range(3):
                row[a + 1] += rotation[i, b, a] * direction[h, b]
            row[0] += row[a + 1] * (rest[i, a] - mean[a] / total)
        square += share * offset[h] ** 2
        for a in range(4):
            vector[a] += share * row[a] * offset[h]
            for b in range(4):
                matrix[a, b] += share * row[a] * row[b]
    return n, square

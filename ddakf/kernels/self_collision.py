"""Stage E, self-collision: pairs of vertices of two layers of a garment, and their contact."""

import numpy as np
from numba import njit

MOST_CELLS = 64  # per axis: bounds the grid where a vertex strays
MOST_SEEN = 1024  # vertices in the 27 cells around that are looked at; of more, an even sample is


@njit(nogil=True, cache=True, error_model="numpy")
def cell_of(position, i, low, cell, dims):
    """Cell of vertex i along each axis.

    Args:
        position: (V, 3) metres.
        i: the vertex.
        low: (3,) corner of the grid, metres.
        cell: metres.
        dims: (3,) cells per axis.
    """
    x = min(dims[0] - 1, int((position[i, 0] - low[0]) / cell))
    y = min(dims[1] - 1, int((position[i, 1] - low[1]) / cell))
    z = min(dims[2] - 1, int((position[i, 2] - low[2]) / cell))
    return x, y, z


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def row_of(start, row, z, cells, n):
    """First and last entry of the cells z - 1 to z + 1 in a row of cells.

    Args:
        start: of the cells, where cell k begins at start[k + 1].
        row: first cell of the row.
        z, cells: cell in the row, and their number.
        n: of all entries.
    """
    last = row + min(cells, z + 2) - 1
    return start[row + max(0, z - 1) + 1], start[last + 2] if last + 2 < start.shape[0] else n


@njit(nogil=True, cache=True, error_model="numpy")
def find_opposite(position, normal, rest, reach, rest_distance, partner, side):
    """Pairs each vertex with the nearest vertex of another layer under or above it.

    Two vertices are of different layers if they are at least ``rest_distance`` from each other at rest. One is under or above the
    other if their distance along the other's tangent plane is at most three quarters of the reach.

    Args:
        position, normal: (V, 3) metres, unit.
        rest: (V, 3) vertices at rest, metres.
        reach, rest_distance: metres.
        partner: (V,) int32 out, -1 where there is none.
        side: (V,) out: 1 on the side of the partner's normal, -1 on the other, 0 without a partner.
    """
    n = position.shape[0]
    low, high = np.empty(3), np.empty(3)
    for a in range(3):
        low[a], high[a] = position[:, a].min(), position[:, a].max()
    cell = max(reach, (high - low).max() / (MOST_CELLS - 1))
    dims = np.empty(3, np.int64)
    for a in range(3):
        dims[a] = int((high[a] - low[a]) / cell) + 1
    start, order = np.zeros(dims[0] * dims[1] * dims[2] + 1, np.int32), np.empty(n, np.int32)
    key = np.empty(n, np.int64)
    for i in range(n):
        x, y, z = cell_of(position, i, low, cell, dims)
        key[i] = (x * dims[1] + y) * dims[2] + z
        start[key[i] + 1] += 1
    for k in range(start.shape[0] - 1):
        start[k + 1] += start[k]
    for i in range(n - 1, -1, -1):
        start[key[i] + 1] -= 1
        order[start[key[i] + 1]] = i
    # cell k now begins at start[k + 1] and ends at start[k + 2], or at n
    for i in range(n):
        partner[i], side[i] = -1, 0.0
        best = reach * reach
        x, y, z = cell_of(position, i, low, cell, dims)
        total = 0
        for cx in range(max(0, x - 1), min(dims[0], x + 2)):
            for cy in range(max(0, y - 1), min(dims[1], y + 2)):
                first, end = row_of(start, (cx * dims[1] + cy) * dims[2], z, dims[2], n)
                total += end - first
        every = total // MOST_SEEN + 1
        for cx in range(max(0, x - 1), min(dims[0], x + 2)):
            for cy in range(max(0, y - 1), min(dims[1], y + 2)):
                first, end = row_of(start, (cx * dims[1] + cy) * dims[2], z, dims[2], n)
                for o in range(first, end, every):
                    j = order[o]
                    dx, dy, dz = position[i, 0] - position[j, 0], position[i, 1] - position[j, 1], position[i, 2] - position[j, 2]
                    squared = dx * dx + dy * dy + dz * dz
                    if squared >= best or j == i:
                        continue
                    rx, ry, rz = rest[i, 0] - rest[j, 0], rest[i, 1] - rest[j, 1], rest[i, 2] - rest[j, 2]
                    if rx * rx + ry * ry + rz * rz < rest_distance * rest_distance:
                        continue
                    height = normal[j, 0] * dx + normal[j, 1] * dy + normal[j, 2] * dz
                    if squared - height * height > 0.5625 * reach * reach:
                        continue
                    best, partner[i], side[i] = squared, j, 1.0 if height >= 0.0 else -1.0


@njit(nogil=True, cache=True, error_model="numpy")
def linearize(position, stencil, normal, gap, area, residual, jacobian, weight):
    """r = min(0, n . (p_i - p_j) - gap), dr/dp = (n, -n) where r is negative.

    Args:
        position: (V, 3) metres.
        stencil: (C, 2) vertices i and j.
        normal: (C, 3) n, unit.
        gap: (C,) metres.
        area: (C,) m^2, weight of a pair that touches.
        residual, jacobian, weight: (C,) metres, (C, 2, 3), (C,) m^2, out; zero where a pair does not touch.
    """
    for c in range(stencil.shape[0]):
        i, j = stencil[c, 0], stencil[c, 1]
        r = -gap[c]
        for a in range(3):
            r += normal[c, a] * (position[i, a] - position[j, a])
        touching = r < 0.0
        residual[c], weight[c] = (r, area[c]) if touching else (0.0, 0.0)
        for a in range(3):
            jacobian[c, 0, a] = normal[c, a] if touching else 0.0
            jacobian[c, 1, a] = -normal[c, a] if touching else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def add_pairs(stencil, residual, jacobian, weight, stiffness, D, force):
    """Adds constraints on two vertices each to the normal equations.

    The two are no neighbours in the mesh, so that A has no block that couples them. Twice their own blocks take its place: with
    these, simultaneous steps of both never overshoot.

    Args:
        stencil, residual, jacobian, weight: of :func:`linearize`.
        stiffness: 1/m^4.
        D: (V, 3, 3) diagonal blocks of A, 1/m^2, added to.
        force: (V, 3) or wider, 1/m, added to.
    """
    for c in range(stencil.shape[0]):
        k = stiffness * weight[c]
        if k == 0.0:
            continue
        for s in range(2):
            i = stencil[c, s]
            for a in range(3):
                force[i, a] -= k * residual[c] * jacobian[c, s, a]
                for b in range(3):
                    D[i, a, b] += 2.0 * k * jacobian[c, s, a] * jacobian[c, s, b]

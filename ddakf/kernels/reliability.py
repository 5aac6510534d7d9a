"""Stage G, reliability (paper, section 2.6)."""

from math import sqrt

import numpy as np
from numba import njit

RINGS = 4  # of cells that the reach is searched in, nearest first
CELLS = 128  # at most along each axis of the grid of vertices


@njit(nogil=True, cache=True, error_model="numpy")
def misfit(points, stride, position, patch, n_patches, reach, boundary, foreign, near, away):
    """How far points lie from a surface, patch by patch, so that what is no more than noise cancels out.

    Every ``stride``-th point is given to the vertex nearest to it. With d_i the offsets of the n points of a patch,
    (|sum d|^2 - sum |d|^2) / (n (n - 1)) has the squared mean offset as its expectation, however noisy the points are.

    Args:
        points: (N, 3) metres.
        position: (V, 3) the fitted vertices, metres.
        patch: (V,) int32 in [0, n_patches).
        reach: metres: points farther from every vertex do not count.
        boundary: (H,) vertices of open boundaries.
        foreign: share of the points beyond ``reach`` above which the cloud is of more than the garment: then points
            do not count that are nearest to a boundary or farther than ``near``.
        near: metres.
        away: (ceil(N / stride),) out, distance of every asked point to its vertex, metres; infinite beyond the reach.

    Returns:
        Squared mean offset over the patches, square metres; zero where no patch has two points.
    """
    n = position.shape[0]
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for v in range(n):
        for a in range(3):
            low[a] = min(low[a], position[v, a])
            high[a] = max(high[a], position[v, a])
    cell = reach / RINGS
    for a in range(3):
        cell = max(cell, (high[a] - low[a]) / (CELLS - 1))
    dims = np.empty(3, np.int64)
    for a in range(3):
        dims[a] = int((high[a] - low[a]) / cell) + 1
    nx, ny, nz = dims[0], dims[1], dims[2]
    start, own = np.zeros(nx * ny * nz + 1, np.int32), np.empty(n, np.int64)
    for v in range(n):
        c = 0
        for a in range(3):
            c = c * dims[a] + min(int((position[v, a] - low[a]) / cell), dims[a] - 1)
        own[v] = c
        start[c + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    order, fill = np.empty(n, np.int32), start[:-1].copy()
    for v in range(n):
        order[fill[own[v]]] = v
        fill[own[v]] += 1
    asked = (points.shape[0] + stride - 1) // stride
    nearest, beyond = np.empty(asked, np.int32), 0
    rings = int(np.ceil(reach / cell))
    for k in range(0, points.shape[0], stride):
        px, py, pz = np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2])
        fx, fy, fz = (px - low[0]) / cell, (py - low[1]) / cell, (pz - low[2]) / cell
        ix, iy, iz = int(np.floor(fx)), int(np.floor(fy)), int(np.floor(fz))
        margin = cell * min(fx - ix, ix + 1 - fx, fy - iy, iy + 1 - fy, fz - iz, iz + 1 - fz)
        best, winner = reach * reach, -1
        for ring in range(1, rings + 1):
            for jx in range(max(ix - ring, 0), min(ix + ring + 1, nx)):
                for jy in range(max(iy - ring, 0), min(iy + ring + 1, ny)):
                    z0, z1 = max(iz - ring, 0), min(iz + ring, nz - 1)
                    if z0 > z1:
                        continue
                    row = (jx * ny + jy) * nz
                    for m in range(start[row + z0], start[row + z1 + 1]):
                        v = order[m]
                        d2 = (position[v, 0] - px) ** 2 + (position[v, 1] - py) ** 2 + (position[v, 2] - pz) ** 2
                        if d2 < best:
                            best, winner = d2, v
            if best <= (ring * cell + margin) ** 2:  # no vertex of the next ring is nearer
                break
        nearest[k // stride] = winner
        away[k // stride] = np.inf if winner < 0 else sqrt(best)
        beyond += winner < 0
    rim = np.zeros(n, np.bool_)
    limit = reach
    if beyond > foreign * asked:
        limit = near
        for h in range(len(boundary)):
            rim[boundary[h]] = True
    count, square, total = np.zeros(n_patches), np.zeros(n_patches), np.zeros((n_patches, 3))
    for k in range(asked):
        winner = nearest[k]
        if winner < 0 or rim[winner] or away[k] > limit:
            continue
        c = patch[winner]
        count[c] += 1.0
        square[c] += away[k] ** 2
        for a in range(3):
            total[c, a] += points[k * stride, a] - position[winner, a]
    pairs = offset = 0.0
    for c in range(n_patches):
        pairs += count[c] * (count[c] - 1.0)
        offset += total[c, 0] ** 2 + total[c, 1] ** 2 + total[c, 2] ** 2 - square[c]
    return max(offset / pairs, 0.0) if pairs > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def strains(position, start, neighbour, rest_length, squared):
    """Mean of (|x_j - x_i| / rest length - 1)^2 over the 2E edges of the one-rings; ``squared`` (V,) out, of each ring."""
    squared[:] = 0.0
    for i in range(position.shape[0]):
        x, y, z, ring = position[i, 0], position[i, 1], position[i, 2], 0.0
        for k in range(start[i + 1] - 1, start[i] - 1, -1):
            j = neighbour[k]
            if j < i:  # ascending: the others had their part in this one's ring before
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
def along_normals(normal, covariance):
    """Sum of n' P n over (V, 3) normals and (V, 3, 3) symmetric covariances."""
    total = 0.0
    for i in range(normal.shape[0]):
        x, y, z, P = normal[i, 0], normal[i, 1], normal[i, 2], covariance[i]
        total += x * x * P[0, 0] + y * y * P[1, 1] + z * z * P[2, 2]
        total += 2.0 * (x * y * P[0, 1] + x * z * P[0, 2] + y * z * P[1, 2])
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def surprise(innovation, R, found):
    """Sum of |y|^2 / trace(R) over the ``found`` (V,) of (V, 3) innovations and (V, 3, 3) covariances."""
    total = 0.0
    for i in range(innovation.shape[0]):
        if found[i]:
            y = innovation[i]
            total += (y[0] * y[0] + y[1] * y[1] + y[2] * y[2]) / (R[i, 0, 0] + R[i, 1, 1] + R[i, 2, 2])
    return total

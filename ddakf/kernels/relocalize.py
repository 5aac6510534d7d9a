"""Initialisation: normals of clouds, soft correspondences between a garment and a cloud, and how far one is from the other."""

from math import sqrt

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.associate import across
from ddakf.kernels.symmetric import smallest_eigenvector

TINY = np.float32(1e-3)  # of a row or column of correspondences: one that has none stays without
LEAST_NEIGHBOURS = 5  # that a normal needs
FINITE = FAST | {"nnan"}  # the numbers of a search are checked ones, and the least of many is found eight at a time
MOST_CELLS = 256  # along an axis of a view's grid


@njit(nogil=True, cache=True, error_model="numpy")
def normals(points, dense, radius, normal):
    """normal (3, N) float32 out: least axis of the ``dense`` (3, D) points within ``radius`` of ``points`` (3, N), metres;
    zero where they are few."""
    limit = radius * radius
    for k in range(points.shape[1]):
        n = 0
        sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
        for j in range(dense.shape[1]):
            x, y, z = dense[0, j] - points[0, k], dense[1, j] - points[1, k], dense[2, j] - points[2, k]
            if x * x + y * y + z * z < limit:
                n += 1
                sx += x
                sy += y
                sz += z
                xx += x * x
                xy += x * y
                xz += x * z
                yy += y * y
                yz += y * z
                zz += z * z
        normal[:, k] = 0.0
        if n < LEAST_NEIGHBOURS:
            continue
        _, _, normal[0, k], normal[1, k], normal[2, k] = smallest_eigenvector(
            xx - sx * sx / n, yy - sy * sy / n, zz - sz * sz / n, xy - sx * sy / n, xz - sx * sz / n, yz - sy * sz / n
        )


@njit(nogil=True, cache=True, error_model="numpy")
def outward(points, dense, directions, cell, depth, normal, signed):
    """Turns normals to the outside, which is where something that is worn is seen from.

    Along each direction the dense points are sorted into a grid that keeps the foremost. A point not behind it is seen from there
    and votes for its normal's turn to it.

    Args:
        points, dense: (3, N), (3, D) float32 metres.
        directions: (K, 3) unit.
        cell, depth: metres, of the grid, and how far behind the foremost a point is seen.
        normal: (3, N) float32 in and out, unit or zero.
        signed: (N,) bool out: seen from somewhere.
    """
    vote = np.zeros(points.shape[1])
    axes, low, high = np.empty((2, 3)), np.empty(2), np.empty(2)
    for d in range(len(directions)):
        view = directions[d]
        across(view, axes)
        low[:], high[:] = np.inf, -np.inf
        for j in range(dense.shape[1]):
            for b in range(2):
                x = axes[b, 0] * dense[0, j] + axes[b, 1] * dense[1, j] + axes[b, 2] * dense[2, j]
                low[b], high[b] = min(low[b], x), max(high[b], x)
        wide = max(cell, (high[0] - low[0]) / MOST_CELLS, (high[1] - low[1]) / MOST_CELLS)
        nx, ny = int((high[0] - low[0]) / wide) + 1, int((high[1] - low[1]) / wide) + 1
        front = np.full((nx, ny), -np.inf)
        for j in range(dense.shape[1]):
            x = axes[0, 0] * dense[0, j] + axes[0, 1] * dense[1, j] + axes[0, 2] * dense[2, j]
            y = axes[1, 0] * dense[0, j] + axes[1, 1] * dense[1, j] + axes[1, 2] * dense[2, j]
            z = view[0] * dense[0, j] + view[1] * dense[1, j] + view[2] * dense[2, j]
            ix, iy = int((x - low[0]) / wide), int((y - low[1]) / wide)
            front[ix, iy] = max(front[ix, iy], z)
        for k in range(points.shape[1]):
            x = axes[0, 0] * points[0, k] + axes[0, 1] * points[1, k] + axes[0, 2] * points[2, k]
            y = axes[1, 0] * points[0, k] + axes[1, 1] * points[1, k] + axes[1, 2] * points[2, k]
            z = view[0] * points[0, k] + view[1] * points[1, k] + view[2] * points[2, k]
            ix = min(max(int((x - low[0]) / wide), 0), nx - 1)
            iy = min(max(int((y - low[1]) / wide), 0), ny - 1)
            if z >= front[ix, iy] - depth:
                vote[k] += view[0] * normal[0, k] + view[1] * normal[1, k] + view[2] * normal[2, k]
    for k in range(points.shape[1]):
        signed[k] = vote[k] != 0.0
        if vote[k] < 0.0:
            for a in range(3):
                normal[a, k] = -normal[a, k]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FINITE)
def correspond(vertex, normal, share, point, point_normal, signed, reach, rounds, outlier, pair, mass, goal):
    """Which vertex belongs to which point, softly and about one to one.

    A pair counts (1 - d^2 / reach^2)^2 (n . n')^2. Rows and columns are then scaled towards sums of one in turn (Sinkhorn), so
    that every part of the cloud finds its part of the garment and none takes the place of two (Chui and Rangarajan 2003).
    Columns are scaled towards the share of their vertex.

    Args:
        vertex, normal: (3, M) float32 metres, unit.
        share: (M,) float32, area of each vertex over the mean, 0 for one that has no points.
        point, point_normal: (3, N) float32 metres, unit; zero: it counts as one that agrees by halves.
        signed: (N,) bool: the sign of the point's normal is known.
        reach: metres.
        rounds: of the scaling.
        outlier: weight of a point's belonging to nothing, in pairs.
        pair: (N, M) float32, workspace.
        mass: (M,) float32 out, points that belong to each vertex.
        goal: (3, M) float32 out, their mean, metres; anything where mass is 0.
    """
    N, M = point.shape[1], vertex.shape[1]
    inverse, zero, one, half = np.float32(1.0 / (reach * reach)), np.float32(0.0), np.float32(1.0), np.float32(0.5)
    column = np.zeros(M, np.float32)
    for n in range(N):
        px, py, pz = point[0, n], point[1, n], point[2, n]
        nx, ny, nz = point_normal[0, n], point_normal[1, n], point_normal[2, n]
        unknown = nx * nx + ny * ny + nz * nz < half
        row, oriented = pair[n], signed[n]
        for m in range(M):
            x, y, z = vertex[0, m] - px, vertex[1, m] - py, vertex[2, m] - pz
            w = max(one - (x * x + y * y + z * z) * inverse, zero)
            c = nx * normal[0, m] + ny * normal[1, m] + nz * normal[2, m]
            c = max(c, zero) if oriented else c
            c2 = half if unknown else c * c
            row[m] = w * w * c2 * share[m]
            column[m] += row[m]
    for _ in range(rounds):
        for m in range(M):
            column[m] = share[m] / (column[m] + TINY)
        new = np.zeros(M, np.float32)
        for n in range(N):
            row, total = pair[n], zero
            for m in range(M):
                row[m] *= column[m]
                total += row[m]
            total = one / (total + TINY)
            for m in range(M):
                row[m] *= total
                new[m] += row[m]
        column = new
    mass[:] = zero
    goal[:] = zero
    for n in range(N):
        row, total = pair[n], np.float32(outlier)
        for m in range(M):
            total += row[m]
        total = one / total
        px, py, pz = point[0, n], point[1, n], point[2, n]
        for m in range(M):
            p = row[m] * total
            mass[m] += p
            goal[0, m] += p * px
            goal[1, m] += p * py
            goal[2, m] += p * pz
    for m in range(M):
        w = one / max(mass[m], np.float32(1e-20))
        goal[0, m] *= w
        goal[1, m] *= w
        goal[2, m] *= w


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FINITE)
def mean_distance(start, end, asked, answers, truncation):
    """Metres: mean distance of the ``asked`` (M,) of ``start`` (3, M) to the nearest of ``end`` (3, N) that ``answers`` (N,).

    Both weights are float32, 0 or 1. A distance counts as ``truncation`` where it is longer, and so does the whole where nothing
    is asked or answers.
    """
    total, count, limit = 0.0, 0, np.float32(truncation * truncation)
    far = np.empty(end.shape[1], np.float32)
    for j in range(end.shape[1]):
        far[j] = np.float32(1e6) * (np.float32(1.0) - answers[j])
    for i in range(start.shape[1]):
        if asked[i] == 0.0:
            continue
        px, py, pz = start[0, i], start[1, i], start[2, i]
        best = limit
        for j in range(end.shape[1]):
            x, y, z = end[0, j] - px, end[1, j] - py, end[2, j] - pz
            best = min(best, x * x + y * y + z * z + far[j])
        total += sqrt(best)
        count += 1
    return total / count if count else truncation

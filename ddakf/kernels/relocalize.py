"""Relocalization: normals of a cloud, soft correspondences between a garment and a cloud, and their mean distance."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.symmetric import smallest_eigenvector
from ddakf.kernels.visibility import perpendicular_axes

TINY = np.float32(1e-3)  # added to the sum of a row or column of correspondences: one without any stays so
LEAST_NEIGHBOURS = 5  # of a normal
FINITE = FAST | {"nnan"}  # a search has finite numbers, and without NaN the least of many is found eight at a time
MOST_CELLS = 256  # along an axis of a view's grid


class OrientedVertices(NamedTuple):
    """M vertices of a garment that are paired with points."""

    position: np.ndarray  # (3, M) float32 m
    normal: np.ndarray  # (3, M) float32 unit
    share: np.ndarray  # (M,) float32 area of each over the mean; 0: no points belong to it


class OrientedPoints(NamedTuple):
    """N points of a cloud that are paired with vertices."""

    position: np.ndarray  # (3, N) float32 m
    normal: np.ndarray  # (3, N) float32 unit; zero where it is unknown
    signed: np.ndarray  # (N,) bool: the sign of the normal is known


class Pairing(NamedTuple):
    """Numbers of a soft correspondence."""

    reach: float  # m: vertices and points farther apart are no pairs
    rounds: int  # of the scaling towards one to one
    outlier: float  # weight of a point's belonging to no vertex, in pairs


@njit(nogil=True, cache=True, error_model="numpy")
def normals(points, dense, radius, normal):
    """Normals of points: the least axis of the points around each.

    Args:
        points, dense: (3, N), (3, D) float32 metres.
        radius: metres; the ``dense`` points within it are those around a point.
        normal: (3, N) float32 out, unit; zero where fewer than LEAST_NEIGHBOURS points are around.
    """
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
    """Turns normals to the outside of a garment, the side from which its cloth is visible.

    For each direction a grid across it holds the foremost of the dense points. A point that is not behind them is visible from
    that direction and votes for the sign of its normal that faces it.

    Args:
        points, dense: (3, N), (3, D) float32 metres.
        directions: (K, 3) unit.
        cell: of the grid, metres.
        depth: distance behind the foremost point up to which a point is visible, metres.
        normal: (3, N) float32 in and out, unit or zero.
        signed: (N,) bool out: visible from some direction.
    """
    vote = np.zeros(points.shape[1])
    axes, low, high = np.empty((2, 3)), np.empty(2), np.empty(2)
    for d in range(len(directions)):
        view = directions[d]
        perpendicular_axes(view, axes)
        low[:], high[:] = np.inf, -np.inf
        for j in range(dense.shape[1]):
            for b in range(2):
                x = axes[b, 0] * dense[0, j] + axes[b, 1] * dense[1, j] + axes[b, 2] * dense[2, j]
                low[b], high[b] = min(low[b], x), max(high[b], x)
        size = max(cell, (high[0] - low[0]) / MOST_CELLS, (high[1] - low[1]) / MOST_CELLS)
        nx, ny = int((high[0] - low[0]) / size) + 1, int((high[1] - low[1]) / size) + 1
        front = np.full((nx, ny), -np.inf)
        for j in range(dense.shape[1]):
            x = axes[0, 0] * dense[0, j] + axes[0, 1] * dense[1, j] + axes[0, 2] * dense[2, j]
            y = axes[1, 0] * dense[0, j] + axes[1, 1] * dense[1, j] + axes[1, 2] * dense[2, j]
            z = view[0] * dense[0, j] + view[1] * dense[1, j] + view[2] * dense[2, j]
            ix, iy = int((x - low[0]) / size), int((y - low[1]) / size)
            front[ix, iy] = max(front[ix, iy], z)
        for k in range(points.shape[1]):
            x = axes[0, 0] * points[0, k] + axes[0, 1] * points[1, k] + axes[0, 2] * points[2, k]
            y = axes[1, 0] * points[0, k] + axes[1, 1] * points[1, k] + axes[1, 2] * points[2, k]
            z = view[0] * points[0, k] + view[1] * points[1, k] + view[2] * points[2, k]
            ix = min(max(int((x - low[0]) / size), 0), nx - 1)
            iy = min(max(int((y - low[1]) / size), 0), ny - 1)
            if z >= front[ix, iy] - depth:
                vote[k] += view[0] * normal[0, k] + view[1] * normal[1, k] + view[2] * normal[2, k]
    for k in range(points.shape[1]):
        signed[k] = vote[k] != 0.0
        if vote[k] < 0.0:
            for a in range(3):
                normal[a, k] = -normal[a, k]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FINITE)
def correspond(vertices, points, pairing, pair, mass, goal):
    """Pairs vertices with points, softly and about one to one.

    A pair weighs (1 - d^2 / reach^2)^2 (n . n')^2; an unknown normal counts as (n . n')^2 = 1/2. Rows and columns are then
    scaled in turn towards sums of one (Sinkhorn), so that every part of the cloud finds its part of the garment and none takes
    the place of two (Chui and Rangarajan 2003). Columns are scaled towards the share of their vertex.

    Args:
        vertices: :class:`OrientedVertices`.
        points: :class:`OrientedPoints`.
        pairing: :class:`Pairing`.
        pair: (N, M) float32 workspace.
        mass: (M,) float32 out, points that belong to each vertex.
        goal: (3, M) float32 out, their mean, metres; anything where mass is 0.
    """
    vertex, normal, share = vertices
    point, point_normal, signed = points
    reach, rounds, outlier = pairing
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
def mean_distance(start, end, start_used, end_used, truncation):
    """Mean distance of some points to the nearest of some others, metres; ``truncation`` where one of the sets is empty.

    Args:
        start, end: (3, M), (3, N) float32 metres.
        start_used, end_used: (M,), (N,) float32, 1 for the points in use, else 0.
        truncation: metres; a longer distance counts as this one.
    """
    total, count, limit = 0.0, 0, np.float32(truncation * truncation)
    far = np.empty(end.shape[1], np.float32)
    for j in range(end.shape[1]):
        far[j] = np.float32(1e6) * (np.float32(1.0) - end_used[j])
    for i in range(start.shape[1]):
        if start_used[i] == 0.0:
            continue
        px, py, pz = start[0, i], start[1, i], start[2, i]
        best = limit
        for j in range(end.shape[1]):
            x, y, z = end[0, j] - px, end[1, j] - py, end[2, j] - pz
            best = min(best, x * x + y * y + z * z + far[j])
        total += sqrt(best)
        count += 1
    return total / count if count else truncation

"""Rigid motions of a surface: how much of each lies along its normals (stage F, sizes of the error)."""

from math import sqrt

import numpy as np
from numba import njit

MOST_SWEEPS = 16  # of Jacobi's rotations; five to seven end at rounding


@njit(nogil=True, cache=True, error_model="numpy")
def rigid_motions(vertices, faces, along, moved):
    """Sums over the faces, weighted by area, of the squared motion along the normal and of the whole squared motion.

    A rigid motion (t, w) moves a point r from the middle by t + w x r, thus by (t, w) . (n, r x n) along its normal. Lengths are
    relative to the root mean square distance from the middle.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3).
        along, moved: (6, 6) out, quadratic forms in (t, w).

    Returns:
        The area, square metres; the results are 0 where that is 0.
    """
    n = faces.shape[0]
    normal, away, area = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    middle, total = np.zeros(3), 0.0
    along[:], moved[:] = 0.0, 0.0
    for f in range(n):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = sqrt(x * x + y * y + z * z)
        area[f] = length
        total += length
        scale = 1.0 / length if length > 0.0 else 0.0
        normal[f, 0], normal[f, 1], normal[f, 2] = scale * x, scale * y, scale * z
        for k in range(3):
            away[f, k] = (a[k] + b[k] + c[k]) / 3.0
            middle[k] += length * away[f, k]
    if not total > 0.0:
        return 0.0
    squared = 0.0
    for f in range(n):
        for k in range(3):
            away[f, k] -= middle[k] / total
            squared += area[f] * away[f, k] * away[f, k]
    unit = max(sqrt(squared / total), 1e-300)  # all in one place: turning moves nothing
    spread, g = np.zeros((3, 3)), np.empty(6)
    for f in range(n):
        w = area[f] / total
        for k in range(3):
            away[f, k] /= unit
        r, m = away[f], normal[f]
        g[0], g[1], g[2] = m[0], m[1], m[2]
        g[3], g[4], g[5] = r[1] * m[2] - r[2] * m[1], r[2] * m[0] - r[0] * m[2], r[0] * m[1] - r[1] * m[0]
        for i in range(6):
            for j in range(6):
                along[i, j] += w * g[i] * g[j]
        for i in range(3):
            for j in range(3):
                spread[i, j] += w * r[i] * r[j]
    trace = spread[0, 0] + spread[1, 1] + spread[2, 2]
    for i in range(3):
        moved[i, i] = 1.0
        moved[3 + i, 3 + i] = trace
        for j in range(3):
            moved[3 + i, 3 + j] -= spread[i, j]
    return 0.5 * total


@njit(nogil=True, cache=True, error_model="numpy")
def smallest_share(along, moved, least):
    """Smallest eigenvalue x of along m = x moved m, for the quadratic forms of :func:`rigid_motions`.

    The rotations' part of ``moved`` is factorised (Cholesky), which leaves an ordinary eigenvalue problem; Jacobi's rotations
    solve that.

    Args:
        along, moved: (6, 6); both are overwritten.
        least: added to the rotations' part of the diagonal of ``moved``.
    """
    A, L = along, moved
    for j in range(3, 6):
        for k in range(3, j):
            L[j, j] -= L[j, k] * L[j, k]
        L[j, j] = sqrt(L[j, j] + least)
        for i in range(j + 1, 6):
            for k in range(3, j):
                L[i, j] -= L[i, k] * L[j, k]
            L[i, j] /= L[j, j]
    for c in range(6):  # A <- L^-1 A L'^-1; of the translations ``moved`` is the identity
        for i in range(3, 6):
            for k in range(3, i):
                A[i, c] -= L[i, k] * A[k, c]
            A[i, c] /= L[i, i]
    for r in range(6):
        for i in range(3, 6):
            for k in range(3, i):
                A[r, i] -= L[i, k] * A[r, k]
            A[r, i] /= L[i, i]
    for _ in range(MOST_SWEEPS):
        off = on = 0.0
        for i in range(6):
            on += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > 1e-32 * on:
            break
        for p in range(5):
            for q in range(p + 1, 6):
                if A[p, q] == 0.0:
                    continue
                theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + sqrt(theta * theta + 1.0))
                c = 1.0 / sqrt(t * t + 1.0)
                s = t * c
                for k in range(6):
                    x, y = A[k, p], A[k, q]
                    A[k, p], A[k, q] = c * x - s * y, s * x + c * y
                for k in range(6):
                    x, y = A[p, k], A[q, k]
                    A[p, k], A[q, k] = c * x - s * y, s * x + c * y
    smallest = A[0, 0]
    for i in range(1, 6):
        smallest = min(smallest, A[i, i])
    return smallest


@njit(nogil=True, cache=True, error_model="numpy")
def mean_of_rings(values, start, neighbour, mean):
    """Mean of each vertex and its neighbours, into ``mean``.

    Args:
        values, mean: (V, C), in and out.
        start, neighbour: the one-rings.
    """
    for i in range(values.shape[0]):
        count = start[i + 1] - start[i] + 1
        for c in range(values.shape[1]):
            total = values[i, c]
            for e in range(start[i], start[i + 1]):
                total += values[neighbour[e], c]
            mean[i, c] = total / count

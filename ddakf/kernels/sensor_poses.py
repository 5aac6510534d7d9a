"""Sensor poses: how far apart two sensors see the same surface (Besl and McKay 1992; Chen and Medioni 1992, point to plane)."""

from math import sqrt

import numpy as np
from numba import njit

from ddakf.kernels.symmetric import smallest_eigenvector

LEAST = 5  # points of a sensor that tell a plane
ALIKE = 0.85  # least cosine between the normals of one surface
BESIDE = 0.4  # of the radius: largest distance along the surface between the middles of two neighbourhoods
FLAT, WIDE = 0.3, 0.03  # of a plane: largest share of the middle eigenvalue that the smallest is; least of the squared radius


@njit(nogil=True, cache=True, error_model="numpy")
def tell_apart(origin, distinct, sensor):
    """Numbers the distinct rows of (N, 3) ``origin`` as they come, and returns how many there are.

    Args:
        origin: (N, 3) metres.
        distinct: (C, 3) out, the first rows; C is enough.
        sensor: (N,) int32 out, number of each row.
    """
    n = k = 0
    for i in range(origin.shape[0]):
        x, y, z = origin[i, 0], origin[i, 1], origin[i, 2]
        if n == 0 or distinct[k, 0] != x or distinct[k, 1] != y or distinct[k, 2] != z:
            k = 0
            while k < n and (distinct[k, 0] != x or distinct[k, 1] != y or distinct[k, 2] != z):
                k += 1
            if k == n:
                distinct[n, 0], distinct[n, 1], distinct[n, 2] = x, y, z
                n += 1
        sensor[i] = k
    return n


@njit(nogil=True, cache=True, error_model="numpy")
def first_rows(rows, first):
    """Finds where each distinct row of (N, 3) ``rows`` comes first, and returns how many there are: at most one more than fit.

    Args:
        rows: (N, 3).
        first: (C,) int64 out.
    """
    n = k = 0
    for i in range(rows.shape[0]):
        x, y, z = rows[i, 0], rows[i, 1], rows[i, 2]
        if n and rows[first[k], 0] == x and rows[first[k], 1] == y and rows[first[k], 2] == z:
            continue
        k = 0
        while k < n and (rows[first[k], 0] != x or rows[first[k], 1] != y or rows[first[k], 2] != z):
            k += 1
        if k == n:
            if n == len(first):
                return n + 1
            first[n] = i
            n += 1
    return n


@njit(nogil=True, cache=True, error_model="numpy")
def move(points, origin, sensor, shift, moved_points, moved_origin):
    """Points (N, 3) float32 and their origins (N, 3) without the (C, 3) shift of their ``sensor``, into arrays alike; metres."""
    for i in range(points.shape[0]):
        for a in range(3):
            off = shift[sensor[i], a]
            moved_points[i, a] = points[i, a] - off
            moved_origin[i, a] = origin[i, a] - off


@njit(nogil=True, cache=True, error_model="numpy")
def accumulate(points, grid, sensor, eye, stride, information, vector):
    """Adds the normal equations of the sensors' shifts: n . (a - b) = n . (shift of a's sensor - shift of b's).

    Around every ``stride``-th point, a and b are the middles of its sensor's points and of another's, and n is the mean of the
    unit normals of both. Tukey's weight ends at the radius.

    Args:
        points: (3, M) float32 sorted by cell, relative to the grid's origin, metres.
        grid: :class:`Grid`, whose cell is the radius.
        sensor: (M,) int32 in [0, C), of each point.
        eye: (C, 3) the sensors, relative to the grid's origin, metres.
        stride: of the sorted points.
        information: (3C, 3C) in and out.
        vector: (3C,) in and out, metres.
    """
    start, _, radius, dims = grid
    r2, inverse = radius * radius, 1.0 / radius
    count, sums, normal = np.empty(len(eye), np.int32), np.empty((len(eye), 10)), np.empty((len(eye), 3))
    n, d = np.empty(3), np.empty(3)
    for i in range(0, points.shape[1], stride):
        x, y, z = points[0, i], points[1, i], points[2, i]
        count[:], sums[:] = 0, 0.0
        ix, iy, iz = int(x * inverse), int(y * inverse), int(z * inverse)
        for jx in range(max(ix - 1, 0), min(ix + 2, dims[0])):
            for jy in range(max(iy - 1, 0), min(iy + 2, dims[1])):
                row = (jx * dims[1] + jy) * dims[2]
                for k in range(start[row + max(iz - 1, 0)], start[row + min(iz + 2, dims[2])]):
                    dx, dy, dz = points[0, k] - x, points[1, k] - y, points[2, k] - z
                    w = 1.0 - (dx * dx + dy * dy + dz * dz) / r2
                    if w > 0.0:
                        add(sums[sensor[k]], w * w, dx, dy, dz)
                        count[sensor[k]] += 1
        own = sensor[i]
        if count[own] < LEAST or not plane(sums[own], r2, eye[own, 0] - x, eye[own, 1] - y, eye[own, 2] - z, normal[own]):
            continue
        for other in range(len(eye)):
            if other == own or count[other] < LEAST:
                continue
            if not plane(sums[other], r2, eye[other, 0] - x, eye[other, 1] - y, eye[other, 2] - z, normal[other]):
                continue
            cosine = along = apart2 = 0.0
            for a in range(3):
                cosine += normal[own, a] * normal[other, a]
            if cosine < ALIKE:
                continue
            length = sqrt(2.0 + 2.0 * cosine)
            for a in range(3):
                n[a] = (normal[own, a] + normal[other, a]) / length
                d[a] = sums[own, 1 + a] / sums[own, 0] - sums[other, 1 + a] / sums[other, 0]
                along += n[a] * d[a]
                apart2 += d[a] * d[a]
            if apart2 - along * along > BESIDE * BESIDE * r2 or along * along >= r2:
                continue
            add_equation(own, other, n, along, (1.0 - along * along / r2) ** 2, information, vector)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def add(sums, w, x, y, z):
    """Adds a weighted difference to the ten sums 1, x y z, xx yy zz, xy xz yz."""
    sums[0] += w
    sums[1] += w * x
    sums[2] += w * y
    sums[3] += w * z
    sums[4] += w * x * x
    sums[5] += w * y * y
    sums[6] += w * z * z
    sums[7] += w * x * y
    sums[8] += w * x * z
    sums[9] += w * y * z


@njit(nogil=True, cache=True, error_model="numpy")
def plane(sums, r2, ex, ey, ez, normal):
    """Whether the points of :func:`add` span a plane; its unit normal (3,), toward (ex, ey, ez), is written."""
    s = 1.0 / sums[0]
    x, y, z = sums[1] * s, sums[2] * s, sums[3] * s
    smallest, middle, nx, ny, nz = smallest_eigenvector(
        sums[4] * s - x * x, sums[5] * s - y * y, sums[6] * s - z * z,
        sums[7] * s - x * y, sums[8] * s - x * z, sums[9] * s - y * z,
    )  # fmt: skip
    toward = 1.0 if nx * ex + ny * ey + nz * ez > 0.0 else -1.0
    normal[0], normal[1], normal[2] = toward * nx, toward * ny, toward * nz
    return middle > WIDE * r2 and smallest < FLAT * middle


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def add_equation(first, second, n, r, w, information, vector):
    """Adds the normal equations of n . (shift of the first - shift of the second) = r with weight w."""
    for a in range(3):
        i, j = 3 * first + a, 3 * second + a
        vector[i] += w * r * n[a]
        vector[j] -= w * r * n[a]
        for b in range(3):
            k, m = 3 * first + b, 3 * second + b
            both = w * n[a] * n[b]
            information[i, k] += both
            information[j, m] += both
            information[i, m] -= both
            information[j, k] -= both

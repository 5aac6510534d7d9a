"""Cluster alignment, stages B to F on clusters that move rigidly: their normal equations and their motion."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST


class ClusterFrames(NamedTuple):
    """K clusters of V vertices."""

    cluster: np.ndarray  # (V,) int32 cluster of each vertex
    center: np.ndarray  # (K, 3) m


class SamplePlanes(NamedTuple):
    """Measurements of V vertices."""

    target: np.ndarray  # (V, 3) m
    normal: np.ndarray  # (V, 3) unit
    weight: np.ndarray  # (V,), 0 where there is none


class SampleNoise(NamedTuple):
    """Noise of the measurements and of the prior, and the vertices that a sampled one stands for."""

    variance: float  # m^2, along the normal
    tangential: float  # m^2, in the plane; infinite: it is unknown there
    information: float  # 1/m^2, of the prior of each vertex
    share: float  # vertices per sampled one


class SeamStiffness(NamedTuple):
    """Stiffness of the edges between two clusters."""

    weakening: float  # factor on the weights of local rigidity
    stretch: float  # 1/m^2
    strain_scale: float  # strain beyond which it counts as an error of the model


class Elimination(NamedTuple):
    """Order in which the clusters' unknowns are eliminated, so that clusters with a seam are near each other."""

    order: np.ndarray  # (K,) int32, the clusters
    first: np.ndarray  # (K,) int32, by place in the order: the first place whose cluster has a seam with this one
    width: int  # unknowns in the longest row of the factor


@njit(nogil=True, cache=True, error_model="numpy")
def centers(position, cluster, center):
    """Centroids of clusters.

    Args:
        position: (V, 3) metres.
        cluster: (V,) of each vertex, in [0, K).
        center: (K, 3) out, metres.
    """
    count = np.zeros(center.shape[0])
    center[:] = 0.0
    for i in range(position.shape[0]):
        count[cluster[i]] += 1.0
        for a in range(3):
            center[cluster[i], a] += position[i, a]
    for k in range(center.shape[0]):
        for a in range(3):
            center[k, a] /= max(count[k], 1.0)


@njit(nogil=True, cache=True, error_model="numpy")
def add_planes(position, prior, sample, clusters, planes, noise, A, b):
    """Adds the measurements and the prior of the sampled vertices to the normal equations of the clusters.

    A cluster moves by x + omega x (x - c) + t; its unknowns are (omega, t).

    Args:
        position, prior: (V, 3) estimate and prediction, metres.
        sample: (S,) indices of the sampled vertices.
        clusters: :class:`ClusterFrames`.
        planes: :class:`SamplePlanes`.
        noise: :class:`SampleNoise`.
        A: (6K, 6K) in and out, lower triangle of each 6x6 block row.
        b: (6K,) in and out.
    """
    cluster, center = clusters
    target, normal, weight = planes
    variance, tangential, information, share = noise
    row = np.empty(6)
    for s in range(sample.shape[0]):
        i = sample[s]
        k = 6 * cluster[i]
        rx, ry, rz = (position[i, 0] - center[cluster[i], 0], position[i, 1] - center[cluster[i], 1],
                      position[i, 2] - center[cluster[i], 2])  # fmt: skip
        w = share * weight[i]
        across = share * information
        dx = share * information * (prior[i, 0] - position[i, 0])
        dy = share * information * (prior[i, 1] - position[i, 1])
        dz = share * information * (prior[i, 2] - position[i, 2])
        if w > 0.0:
            t = w / tangential
            zx, zy, zz = target[i, 0] - position[i, 0], target[i, 1] - position[i, 1], target[i, 2] - position[i, 2]
            across += t
            dx += t * zx
            dy += t * zy
            dz += t * zz
            nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
            along = w / variance - t
            row[0], row[1], row[2] = ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx
            row[3], row[4], row[5] = nx, ny, nz
            d = along * (nx * zx + ny * zy + nz * zz)
            for a in range(6):
                b[k + a] += d * row[a]
                for c in range(a + 1):
                    A[k + a, k + c] += along * row[a] * row[c]
        # isotropic part: J = [-[r]x, I]
        b[k] += ry * dz - rz * dy
        b[k + 1] += rz * dx - rx * dz
        b[k + 2] += rx * dy - ry * dx
        b[k + 3] += dx
        b[k + 4] += dy
        b[k + 5] += dz
        A[k, k] += across * (ry * ry + rz * rz)
        A[k + 1, k + 1] += across * (rx * rx + rz * rz)
        A[k + 2, k + 2] += across * (rx * rx + ry * ry)
        A[k + 1, k] -= across * rx * ry
        A[k + 2, k] -= across * rx * rz
        A[k + 2, k + 1] -= across * ry * rz
        A[k + 3, k + 3] += across
        A[k + 4, k + 4] += across
        A[k + 5, k + 5] += across
        A[k + 3, k + 1] += across * rz
        A[k + 3, k + 2] -= across * ry
        A[k + 4, k] -= across * rz
        A[k + 4, k + 2] += across * rx
        A[k + 5, k] += across * ry
        A[k + 5, k + 1] -= across * rx


@njit(nogil=True, cache=True, error_model="numpy")
def add_seams(position, clusters, seam, rest, motion, stiffness, A, b):
    """Adds the coupling of the clusters: local rigidity and length of the edges between them.

    An edge's rigid source turns with both of its clusters, so that a common rotation costs nothing.

    Args:
        position: (V, 3) metres.
        clusters: :class:`ClusterFrames`.
        seam: (C, 3) edges between two clusters: vertices i and j, and the entry of the edge i to j among the one-rings. Those of
            the same two clusters follow each other: their sum is formed apart.
        rest, motion: ``LocalRigidity`` to the rest shape and since the last frame.
        stiffness: :class:`SeamStiffness`.
        A, b: as for :func:`add_planes`.
    """
    cluster, center = clusters
    weakening, stretch, strain_scale = stiffness
    rest_source, rest_rotation, rest_weight = rest.source, rest.rotation, rest.weight
    motion_source, motion_rotation, motion_weight = motion.source, motion.rotation, motion.weight
    rows = np.zeros((19, 12))
    sums, J, weight, residual = rows[:13], rows[13:17], rows[17], rows[18]
    for s in range(seam.shape[0]):
        i, j, e = seam[s, 0], seam[s, 1], seam[s, 2]
        p, q = cluster[i], cluster[j]
        ex, ey, ez = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1], position[j, 2] - position[i, 2]
        rest_w = 0.5 * weakening * (rest_weight[i] + rest_weight[j])
        motion_w = 0.5 * weakening * (motion_weight[i] + motion_weight[j])
        total = rest_w + motion_w
        fx = fy = fz = 0.0  # weighted residual of both terms
        mx = my = mz = 0.0  # weighted mean of the turned sources
        for a in range(2):
            w = rest_w if a == 0 else motion_w
            S = rest_source if a == 0 else motion_source
            R = rest_rotation if a == 0 else motion_rotation
            sx, sy, sz = 0.5 * S[e, 0], 0.5 * S[e, 1], 0.5 * S[e, 2]
            tx = (R[i, 0, 0] + R[j, 0, 0]) * sx + (R[i, 0, 1] + R[j, 0, 1]) * sy + (R[i, 0, 2] + R[j, 0, 2]) * sz
            ty = (R[i, 1, 0] + R[j, 1, 0]) * sx + (R[i, 1, 1] + R[j, 1, 1]) * sy + (R[i, 1, 2] + R[j, 1, 2]) * sz
            tz = (R[i, 2, 0] + R[j, 2, 0]) * sx + (R[i, 2, 1] + R[j, 2, 1]) * sy + (R[i, 2, 2] + R[j, 2, 2]) * sz
            fx += w * (ex - tx)
            fy += w * (ey - ty)
            fz += w * (ez - tz)
            mx += w * tx
            my += w * ty
            mz += w * tz
        half = 0.5 / total if total > 0.0 else 0.0
        mx, my, mz = half * mx, half * my, half * mz
        ix, iy, iz = position[i, 0] - center[p, 0], position[i, 1] - center[p, 1], position[i, 2] - center[p, 2]
        jx, jy, jz = position[j, 0] - center[q, 0], position[j, 1] - center[q, 1], position[j, 2] - center[q, 2]
        # change of the residual: d = dx_j - dx_i - (omega_p + omega_q)/2 x m; J = [[r_i + m]x, -I, [m - r_j]x, I]
        ux, uy, uz = ix + mx, iy + my, iz + mz
        vx, vy, vz = mx - jx, my - jy, mz - jz
        J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = -uz, uy, uz, -ux, -uy, ux
        J[0, 7], J[0, 8], J[1, 6], J[1, 8], J[2, 6], J[2, 7] = -vz, vy, vz, -vx, -vy, vx
        for a in range(3):
            J[a, 3 + a] = -1.0
            J[a, 9 + a] = 1.0
            weight[a] = total
        residual[0], residual[1], residual[2] = fx, fy, fz
        # length: derivative along the edge of dx_j - dx_i alone
        length = sqrt(ex * ex + ey * ey + ez * ez)
        rest = sqrt(rest_source[e, 0] ** 2 + rest_source[e, 1] ** 2 + rest_source[e, 2] ** 2)
        weight[3] = residual[3] = 0.0
        if length >= 1e-9 and rest >= 1e-9:
            strain = length / rest - 1.0
            weight[3] = stretch / (1.0 + (strain / strain_scale) ** 2)
            residual[3] = weight[3] * (length - rest)
            nx, ny, nz = ex / length, ey / length, ez / length
            row = J[3]
            row[0], row[1], row[2] = -(iy * nz - iz * ny), -(iz * nx - ix * nz), -(ix * ny - iy * nx)
            row[3], row[4], row[5] = -nx, -ny, -nz
            row[6], row[7], row[8] = jy * nz - jz * ny, jz * nx - jx * nz, jx * ny - jy * nx
            row[9], row[10], row[11] = nx, ny, nz
        add_squares(rows.reshape(-1))
        last = s + 1 == seam.shape[0]
        if last or cluster[seam[s + 1, 0]] != p or cluster[seam[s + 1, 1]] != q:
            add_pair(sums, 6 * p, 6 * q, A, b)
            sums[:] = 0.0


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def add_squares(rows):
    """Adds J' diag(w) J to the first twelve rows of ``rows`` (19 * 12,), and J' r to the next; J are the four after these.

    The weights w are the first four numbers of row 17, r those of row 18. One flat array, so that the compiler knows how far
    everything is apart, and that nothing overlaps.
    """
    for a in range(12):
        x0, x1 = rows[17 * 12] * rows[13 * 12 + a], rows[17 * 12 + 1] * rows[14 * 12 + a]
        x2, x3 = rows[17 * 12 + 2] * rows[15 * 12 + a], rows[17 * 12 + 3] * rows[16 * 12 + a]
        for c in range(12):
            square = x0 * rows[13 * 12 + c] + x1 * rows[14 * 12 + c] + x2 * rows[15 * 12 + c] + x3 * rows[16 * 12 + c]
            rows[12 * a + c] += square
    x0, x1, x2, x3 = rows[18 * 12], rows[18 * 12 + 1], rows[18 * 12 + 2], rows[18 * 12 + 3]
    for c in range(12):
        product = x0 * rows[13 * 12 + c] + x1 * rows[14 * 12 + c] + x2 * rows[15 * 12 + c] + x3 * rows[16 * 12 + c]
        rows[12 * 12 + c] += product


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def add_pair(sums, p, q, A, b):
    """Adds ``sums`` (13, 12) of the unknowns from p and from q on to the lower triangle of A, and minus the last row to b."""
    for a in range(6):
        b[p + a] -= sums[12, a]
        b[q + a] -= sums[12, 6 + a]
        for c in range(a + 1):
            A[p + a, p + c] += sums[a, c]
            A[q + a, q + c] += sums[6 + a, 6 + c]
        for c in range(6):
            if p > q:
                A[p + a, q + c] += sums[a, 6 + c]
            else:
                A[q + c, p + a] += sums[a, 6 + c]


@njit(nogil=True, cache=True, error_model="numpy")
def move(position, nearest, share, center, motion, limit, moved):
    """Moves the vertices by the blend of their nearest clusters' rigid motions. Returns the RMS step, metres.

    Args:
        position: (V, 3) metres.
        nearest, share: (V, N) clusters that a vertex follows, and by how much; rows of ``share`` sum to one.
        center: (K, 3) metres.
        motion: (K, 6) rotation vector and translation of each.
        limit: longest translation of a cluster, metres.
        moved: (V, 3) out, metres.
    """
    k = center.shape[0]
    R = np.empty((k, 3, 3))
    T = np.empty((k, 3))
    for p in range(k):
        x, y, z = motion[p, 0], motion[p, 1], motion[p, 2]
        # Cayley's rotation of about that angle
        x, y, z = 0.5 * x, 0.5 * y, 0.5 * z
        h2 = x * x + y * y + z * z
        if h2 > 0.25:
            scale = 0.5 / sqrt(h2)
            x, y, z, h2 = x * scale, y * scale, z * scale, 0.25
        t = 2.0 / (1.0 + h2)
        R[p, 0, 0], R[p, 0, 1], R[p, 0, 2] = 1.0 - t * (y * y + z * z), t * (x * y - z), t * (x * z + y)
        R[p, 1, 0], R[p, 1, 1], R[p, 1, 2] = t * (x * y + z), 1.0 - t * (x * x + z * z), t * (y * z - x)
        R[p, 2, 0], R[p, 2, 1], R[p, 2, 2] = t * (x * z - y), t * (y * z + x), 1.0 - t * (x * x + y * y)
        length = sqrt(motion[p, 3] ** 2 + motion[p, 4] ** 2 + motion[p, 5] ** 2)
        scale = min(1.0, limit / max(length, 1e-12))
        for a in range(3):
            T[p, a] = motion[p, 3 + a] * scale + center[p, a]
    total = 0.0
    for i in range(position.shape[0]):
        x = y = z = 0.0
        for m in range(nearest.shape[1]):
            p = nearest[i, m]
            w = share[i, m]
            rx, ry, rz = position[i, 0] - center[p, 0], position[i, 1] - center[p, 1], position[i, 2] - center[p, 2]
            x += w * (R[p, 0, 0] * rx + R[p, 0, 1] * ry + R[p, 0, 2] * rz + T[p, 0])
            y += w * (R[p, 1, 0] * rx + R[p, 1, 1] * ry + R[p, 1, 2] * rz + T[p, 1])
            z += w * (R[p, 2, 0] * rx + R[p, 2, 1] * ry + R[p, 2, 2] * rz + T[p, 2])
        total += (x - position[i, 0]) ** 2 + (y - position[i, 1]) ** 2 + (z - position[i, 2]) ** 2
        moved[i, 0], moved[i, 1], moved[i, 2] = x, y, z
    return sqrt(total / max(position.shape[0], 1))


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def factorise(A, elimination, ridge, factor):
    """Cholesky factor L L' of A + ridge I, in float32, of its envelope alone. Returns whether all pivots were positive.

    A cluster has seams with a few others, and in the order of elimination a row of L begins at the first of them.

    Args:
        A: (6K, 6K) lower triangle.
        elimination: :class:`Elimination`.
        ridge: added to the diagonal.
        factor: (6K, W) float32 out; row i of L from column 6 first[i // 6] on.
    """
    order, first, _ = elimination
    for p in range(order.shape[0]):
        begin = 6 * first[p]
        for q in range(first[p], p + 1):
            high, low = max(order[p], order[q]), min(order[p], order[q])
            for a in range(6):
                for b in range(6 if q < p else a + 1):
                    c, d = (a, b) if order[p] == high else (b, a)
                    factor[6 * p + a, 6 * q + b - begin] = A[6 * high + c, 6 * low + d]
    for i in range(A.shape[0]):
        begin = 6 * first[i // 6]
        row = factor[i]
        for q in range(first[i // 6], i // 6):
            eliminate(row, begin, factor[6 * q : 6 * q + 6], 6 * first[q], 6 * q)
        for j in range(6 * (i // 6), i):
            row[j - begin] = factor[j, j - begin] * (row[j - begin] - inner(row, 0, factor[j], 0, j - begin))
        pivot = row[i - begin] + np.float32(ridge) - inner(row, 0, row, 0, i - begin)
        if not 0.0 < pivot < np.inf:
            return False
        row[i - begin] = np.float32(1.0) / sqrt(pivot)  # the inverse of the diagonal, which is all that is needed of it
    return True


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def eliminate(row, begin, others, other_begin, at):
    """Entries ``at`` to ``at`` + 5 of a row of L, from the six rows of L that end there.

    Args:
        row, begin: (W,) the row, in and out, and its first column.
        others, other_begin: (6, W) the rows of the cluster ``at`` // 6, and their first column.
        at: column.
    """
    common = max(begin, other_begin)
    i, j, n = common - begin, common - other_begin, at - common
    a = b = c = d = e = f = np.float32(0.0)
    for m in range(n):
        value = row[i + m]
        a += value * others[0, j + m]
        b += value * others[1, j + m]
        c += value * others[2, j + m]
        d += value * others[3, j + m]
        e += value * others[4, j + m]
        f += value * others[5, j + m]
    i, j = at - begin, at - other_begin
    a = (row[i] - a) * others[0, j]
    b = (row[i + 1] - b - a * others[1, j]) * others[1, j + 1]
    c = (row[i + 2] - c - a * others[2, j] - b * others[2, j + 1]) * others[2, j + 2]
    d = (row[i + 3] - d - a * others[3, j] - b * others[3, j + 1] - c * others[3, j + 2]) * others[3, j + 3]
    row[i], row[i + 1], row[i + 2], row[i + 3] = a, b, c, d
    e = row[i + 4] - e - inner(row, i, others[4], j, 4)
    row[i + 4] = e * others[4, j + 4]
    f = row[i + 5] - f - inner(row, i, others[5], j, 5)
    row[i + 5] = f * others[5, j + 5]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def inner(a, i, b, j, n):
    """Sum of a[i + m] b[j + m] over n entries."""
    total = np.float32(0.0)
    for m in range(n):
        total += a[i + m] * b[j + m]
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def substitute(factor, elimination, b, x):
    """Solves L L' x = b by forward and backward substitution.

    Args:
        factor, elimination: of :func:`factorise`.
        b: (6K,).
        x: (6K,) out.
    """
    order, first, _ = elimination
    n = len(b)
    y = np.empty(n, np.float32)
    for i in range(n):
        begin = 6 * first[i // 6]
        total = np.float32(b[6 * order[i // 6] + i % 6]) - inner(factor[i], 0, y, begin, i - begin)
        y[i] = total * factor[i, i - begin]
    for i in range(n - 1, -1, -1):
        begin = 6 * first[i // 6]
        y[i] *= factor[i, i - begin]
        for j in range(begin, i):
            y[j] -= factor[i, j - begin] * y[i]
        x[6 * order[i // 6] + i % 6] = y[i]

"""Stage F, covariance (paper, section 2.7): a frame's evidence by patches, and the covariance of each vertex."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels.symmetric import invert3

LEAST = 1e-14  # m^2: variances are at least this


class MeasuredPlanes(NamedTuple):
    """Measurements of V vertices."""

    weight: np.ndarray  # (V,), 0 where there is none
    normal: np.ndarray  # (V, 3) unit
    variance: np.ndarray  # (V,) m^2
    isotropic: bool  # the measurements are points, as well known across the normal as along it


class PatchSums(NamedTuple):
    """Sums over the vertices of each of L patches."""

    size: np.ndarray  # (L,) vertices
    observed: np.ndarray  # (L,) of them measured
    information: np.ndarray  # (L, 6) 1/m^2, xx yy zz xy xz yz
    facing: np.ndarray  # (L, 3) normals of the measurements
    motion: np.ndarray  # (L, 4) m and m^2, the vectors and their squares
    innovation: np.ndarray  # (L, 4) m and m^2, the same of the measured vertices alone
    strain: np.ndarray  # (L,) mean squared strain of the edges at each vertex


@njit(nogil=True, cache=True, error_model="numpy")
def sum_by_patch(position, last, prior, patch, ring_strain, planes, sums):
    """Sums a frame's evidence over the vertices of each patch.

    Args:
        position, last, prior: (V, 3) metres; ``last`` is the position of a vertex that has not moved.
        patch: (V,) int32 in [0, L).
        ring_strain: (V,) mean squared strain of the edges at each vertex.
        planes: :class:`MeasuredPlanes`.
        sums: :class:`PatchSums` out.
    """
    weight, normal, variance, isotropic = planes
    size, observed, information, facing, motion, innovation, strain = sums
    size[:], observed[:], strain[:] = 0.0, 0.0, 0.0
    information[:], facing[:], motion[:], innovation[:] = 0.0, 0.0, 0.0, 0.0
    for i in range(position.shape[0]):
        c = patch[i]
        size[c] += 1.0
        for a in range(3):
            d = position[i, a] - last[i, a]
            motion[c, a] += d
            motion[c, 3] += d * d
        strain[c] += ring_strain[i]
        w = weight[i]
        if w <= 0.0:
            continue
        observed[c] += 1.0
        k = w / variance[i]
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        across = k if isotropic else 0.0
        k -= across
        information[c, 0] += k * x * x + across
        information[c, 1] += k * y * y + across
        information[c, 2] += k * z * z + across
        information[c, 3] += k * x * y
        information[c, 4] += k * x * z
        information[c, 5] += k * y * z
        for a in range(3):
            d = position[i, a] - prior[i, a]
            facing[c, a] += normal[i, a]
            innovation[c, a] += d
            innovation[c, 3] += d * d


@njit(nogil=True, cache=True, error_model="numpy")
def couple_patches(B, crossing, information, smallest, matrix):
    """Matrix of the patches: their coupling, P' A P without the terms on single vertices, plus the information of each.

    No energy that couples vertices changes when all move alike, so that each row of blocks adds up to zero.

    Args:
        B: (2E, 12) float32 1/m^2, blocks of the entries of the one-rings.
        crossing: (C, 3) int32, entries from patch to patch, and the two patches.
        information: (L, 6) 1/m^2, xx yy zz xy xz yz.
        smallest: 1/m^2, added to the diagonal.
        matrix: (3L, 3L) float32 1/m^2, out.
    """
    matrix[:] = 0.0
    for k in range(crossing.shape[0]):
        e, p, q = crossing[k, 0], 3 * crossing[k, 1], 3 * crossing[k, 2]
        for a in range(3):
            for b in range(3):
                matrix[p + a, q + b] += B[e, 4 * b + a]
                matrix[p + a, p + b] -= B[e, 4 * b + a]
    for k in range(information.shape[0]):
        p = 3 * k
        for a in range(3):
            matrix[p + a, p + a] += information[k, a] + smallest
        for m, a, b in ((3, 0, 1), (4, 0, 2), (5, 1, 2)):
            matrix[p + a, p + b] += information[k, m]
            matrix[p + b, p + a] += information[k, m]


@njit(nogil=True, cache=True, error_model="numpy")
def error_transition(inverse, information, F):
    """F = I - inverse blockdiag(information): how an update changes the error of the patches.

    Args:
        inverse: (3L, 3L) float32 m^2.
        information: (L, 6) float32 1/m^2.
        F: (3L, 3L) float32 out.
    """
    for k in range(information.shape[0]):
        p = 3 * k
        a, b, c = information[k, 0], information[k, 1], information[k, 2]
        d, e, f = information[k, 3], information[k, 4], information[k, 5]
        for r in range(F.shape[0]):
            x, y, z = inverse[r, p], inverse[r, p + 1], inverse[r, p + 2]
            F[r, p] = -(x * a + y * d + z * e)
            F[r, p + 1] = -(x * d + y * b + z * f)
            F[r, p + 2] = -(x * e + y * f + z * c)
    for r in range(F.shape[0]):
        F[r, r] += 1.0


@njit(nogil=True, cache=True, error_model="numpy")
def vertex_covariances(shared, bend, patch, planes, covariance):
    """Covariance of each vertex: that of its patch, conditioned on the vertex's own measurement.

    A plane is known along its normal to its variance and, where the patch may slide, to the turn of the normal within the patch:
    the plane that was found is then a neighbour's.

    Args:
        shared: (L, 3, 3) covariance of the patches, m^2.
        bend: (L,) mean squared difference of two normals of a patch.
        patch: (V,) int32 in [0, L).
        planes: :class:`MeasuredPlanes`.
        covariance: (V, 3, 3) m^2, out.
    """
    weight, normal, variance, isotropic = planes
    for i in range(patch.shape[0]):
        P = shared[patch[i]]
        a, b, c, d, e, f = P[0, 0], P[1, 1], P[2, 2], P[0, 1], P[0, 2], P[1, 2]
        w = weight[i]
        if w > 0.0 and not isotropic:
            x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
            gx, gy, gz = a * x + d * y + e * z, d * x + b * y + f * z, e * x + f * y + c * z
            along = gx * x + gy * y + gz * z
            s = 1.0 / (along + variance[i] / w + bend[patch[i]] * (a + b + c - along))
            a, b, c = a - s * gx * gx, b - s * gy * gy, c - s * gz * gz
            d, e, f = d - s * gx * gy, e - s * gx * gz, f - s * gy * gz
        elif w > 0.0:
            added = w / variance[i]
            a, b, c, d, e, f = invert3(a, b, c, d, e, f)
            a, b, c, d, e, f = invert3(a + added, b + added, c + added, d, e, f)
        covariance[i, 0, 0], covariance[i, 1, 1], covariance[i, 2, 2] = a, b, c
        covariance[i, 0, 1] = covariance[i, 1, 0] = d
        covariance[i, 0, 2] = covariance[i, 2, 0] = e
        covariance[i, 1, 2] = covariance[i, 2, 1] = f


@njit(nogil=True, cache=True, error_model="numpy")
def resize(covariance, normal, sizes, usual, resized):
    """Covariances with other sizes along the normals and across them: M C M with M = a n n' + b (I - n n').

    A size is a standard deviation, across the normal the root mean square of two directions. It becomes factor (size /
    usual)^power.

    Args:
        covariance: (V, 3, 3) m^2.
        normal: (V, 3) unit.
        sizes: factors (V,) along and across, metres, and both powers.
        usual: metres.
        resized: (V, 3, 3) m^2, out.
    """
    along, across, powers = sizes
    for i in range(normal.shape[0]):
        C, n = covariance[i], normal[i]
        g0 = C[0, 0] * n[0] + C[0, 1] * n[1] + C[0, 2] * n[2]
        g1 = C[1, 0] * n[0] + C[1, 1] * n[1] + C[1, 2] * n[2]
        g2 = C[2, 0] * n[0] + C[2, 1] * n[1] + C[2, 2] * n[2]
        v = max(g0 * n[0] + g1 * n[1] + g2 * n[2], LEAST)
        t = max(0.5 * (C[0, 0] + C[1, 1] + C[2, 2] - v), LEAST)
        a = along[i] * (np.sqrt(v) / usual) ** powers[0] / np.sqrt(v)
        b = across[i] * (np.sqrt(t) / usual) ** powers[1] / np.sqrt(t)
        g = (g0, g1, g2)
        for r in range(3):
            for c in range(3):
                mixed = b * (a - b) * (g[r] * n[c] + n[r] * g[c])
                resized[i, r, c] = b * b * C[r, c] + mixed + (a - b) ** 2 * v * n[r] * n[c]


@njit(nogil=True, cache=True, error_model="numpy")
def traces(covariance, trace):
    """Traces of (V, 3, 3) blocks, (V,) out."""
    for i in range(covariance.shape[0]):
        trace[i] = covariance[i, 0, 0] + covariance[i, 1, 1] + covariance[i, 2, 2]


@njit(nogil=True, cache=True, error_model="numpy")
def distance_along_cloth(observed, start, neighbour, rest_length, most, distance):
    """Length of the shortest path along edges at rest from each vertex to an observed one.

    A queue holds the vertices whose distance has changed, each at most once (Moore 1959).

    Args:
        observed: (V,) bool.
        start, neighbour: one-rings in compressed rows.
        rest_length: (2E,) metres.
        most: limit of the distances, metres.
        distance: (V,) out, metres.
    """
    n = observed.shape[0]
    queue, waiting = np.empty(n, np.uint32), np.zeros(n, np.bool_)
    count = first = 0
    for i in range(n):
        distance[i] = 0.0 if observed[i] else most
        if observed[i]:
            queue[count] = i
            waiting[i] = True
            count += 1
    while count > 0:
        i = queue[first]
        first = first + 1 if first + 1 < n else 0
        count -= 1
        waiting[i] = False
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            d = distance[i] + rest_length[e]
            if d < distance[j]:
                distance[j] = d
                if not waiting[j]:
                    waiting[j] = True
                    queue[(first + count) % n] = j
                    count += 1


@njit(nogil=True, cache=True, error_model="numpy")
def replace_indefinite(covariance, fallback):
    """Replaces the blocks of (V, 3, 3) ``covariance`` that are not finite and positive definite by those of ``fallback``."""
    for i in range(covariance.shape[0]):
        a, b, c = covariance[i, 0, 0], covariance[i, 1, 1], covariance[i, 2, 2]
        d, e, f = covariance[i, 0, 1], covariance[i, 0, 2], covariance[i, 1, 2]
        minor = a * b - d * d
        determinant = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e)
        finite = abs(a) + abs(b) + abs(c) + abs(d) + abs(e) + abs(f) < np.inf
        if not (a > 0.0 and minor > 0.0 and determinant > 0.0 and finite):
            covariance[i] = fallback[i]

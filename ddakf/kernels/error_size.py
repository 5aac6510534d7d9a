"""Stage F, covariance (paper, section 2.7): the size of each vertex's error along its normal and across it."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels.symmetric import along

LEAST = 1e-14  # m^2: variances are at least this


class LogLaw(NamedTuple):
    """Laws of the size of the error along the normal and across it, of N terms power log(1 + evidence / scale)."""

    scale: np.ndarray  # (N, 2)
    power: np.ndarray  # (N, 2)
    base: np.ndarray  # (2, 2) logarithms of metres, of vertices that were not measured and of those that were


@njit(nogil=True, cache=True, error_model="numpy")
def add_logs(values, scale, power, total):
    """Adds power log(1 + value / scale) of both laws to (2, N) ``total``, of (N,) values; scale and power are (2,)."""
    s, t, p, q = scale[0], scale[1], power[0], power[1]
    for i in range(values.shape[0]):
        if values[i] != 0.0:
            term = np.log(1.0 + values[i] / s)
            total[0, i] += p * term
            total[1, i] += q * (term if s == t else np.log(1.0 + values[i] / t))


@njit(nogil=True, cache=True, error_model="numpy")
def log_factors(of_patches, of_vertices, patch, seen, law, log_factor):
    """Logarithms of the sizes of errors by both laws: a base, and a term for each evidence.

    Args:
        of_patches: (P, L) evidence of patches.
        of_vertices: (K, V) of vertices.
        patch: (V,) int32 in [0, L).
        seen: (V,) bool, vertices that were measured.
        law: :class:`LogLaw`, its terms first of patches and then of vertices.
        log_factor: (2, V) out.
    """
    scale, power, base = law
    n, by_patch = of_patches.shape[0], np.zeros((2, of_patches.shape[1]))
    for k in range(n):
        add_logs(of_patches[k], scale[k], power[k], by_patch)
    for d in range(2):
        for i in range(patch.shape[0]):
            log_factor[d, i] = base[d, 1 if seen[i] else 0] + by_patch[d, patch[i]]
    for k in range(of_vertices.shape[0]):
        add_logs(of_vertices[k], scale[n + k], power[n + k], log_factor)


@njit(nogil=True, cache=True, error_model="numpy")
def variances_by_normal(covariance, normal, variance):
    """Variances along the normals, and across them the mean of two directions.

    Args:
        covariance: (V, 3, 3) m^2.
        normal: (V, 3) unit.
        variance: (2, V) m^2, out.
    """
    for i in range(normal.shape[0]):
        v = along(covariance[i], normal[i, 0], normal[i, 1], normal[i, 2])
        variance[0, i] = max(v, LEAST)
        variance[1, i] = max(0.5 * (covariance[i, 0, 0] + covariance[i, 1, 1] + covariance[i, 2, 2] - v), LEAST)


@njit(nogil=True, cache=True, error_model="numpy")
def resize(covariance, normal, scale, resized):
    """Covariances scaled along the normals and across them: M C M with M = a n n' + b (I - n n').

    Args:
        covariance: (V, 3, 3) m^2.
        normal: (V, 3) unit.
        scale: (2, V) factors a and b.
        resized: (V, 3, 3) m^2, out.
    """
    for i in range(normal.shape[0]):
        C, x, y, z = covariance[i], normal[i, 0], normal[i, 1], normal[i, 2]
        gx = C[0, 0] * x + C[0, 1] * y + C[0, 2] * z
        gy = C[0, 1] * x + C[1, 1] * y + C[1, 2] * z
        gz = C[0, 2] * x + C[1, 2] * y + C[2, 2] * z
        a, b = scale[0, i], scale[1, i]
        bb, mixed, rest = b * b, b * (a - b), 0.5 * (a - b) ** 2 * (gx * x + gy * y + gz * z)
        hx, hy, hz = mixed * gx + rest * x, mixed * gy + rest * y, mixed * gz + rest * z
        resized[i, 0, 0] = bb * C[0, 0] + 2.0 * hx * x
        resized[i, 1, 1] = bb * C[1, 1] + 2.0 * hy * y
        resized[i, 2, 2] = bb * C[2, 2] + 2.0 * hz * z
        resized[i, 0, 1] = resized[i, 1, 0] = bb * C[0, 1] + hx * y + hy * x
        resized[i, 0, 2] = resized[i, 2, 0] = bb * C[0, 2] + hx * z + hz * x
        resized[i, 1, 2] = resized[i, 2, 1] = bb * C[1, 2] + hy * z + hz * y


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
                    last = first + count
                    queue[last if last < n else last - n] = j
                    count += 1

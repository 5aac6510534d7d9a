"""Stage F, covariance (paper, section 2.7): a frame's evidence by patches, and each vertex's covariance."""

import numpy as np
from numba import njit

from ddakf.kernels.symmetric import invert3


@njit(nogil=True, cache=True, error_model="numpy")
def gather(
    position, last, prior, patch, ring_strain, weight, normal, variance, isotropic,
    size, observed, information, facing, motion, innovation, strain,
):  # fmt: skip
    """Sums over the vertices of each patch.

    Args:
        position, last, prior: (V, 3) m; ``last`` is where the vertex would be had it not moved.
        patch: (V,) of the model.
        ring_strain: (V,) mean squared strain of the edges at each vertex.
        weight, normal, variance, isotropic: of the measurements; isotropic ones are known as well across as along.
        size, observed: (L,) out, vertices and measured ones.
        information: (L, 6) out, 1/m^2, xx yy zz xy xz yz.
        facing: (L, 3) out, normals of the measurements.
        motion, innovation: (L, 4) out, the vectors and their squares; the innovation of measured vertices alone, m and m^2.
        strain: (L,) out, of ``ring_strain``.
    """
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
def couple(B, crossing, information, smallest, coarse):
    """coarse (3L, 3L) float32 out: what couples the patches, P' A P without what holds a vertex on its own, and what holds each,
    the ``information`` (L, 6), xx yy zz xy xz yz, and the ``smallest``, 1/m^2.

    No energy that couples vertices changes when all move alike: each row of blocks adds up to nothing. ``crossing`` (C, 3) are
    the rows of B from patch to patch, and the two patches.
    """
    coarse[:] = 0.0
    for k in range(crossing.shape[0]):
        e, p, q = crossing[k, 0], 3 * crossing[k, 1], 3 * crossing[k, 2]
        for a in range(3):
            for b in range(3):
                coarse[p + a, q + b] += B[e, 4 * b + a]
                coarse[p + a, p + b] -= B[e, 4 * b + a]
    for k in range(information.shape[0]):
        p = 3 * k
        for a in range(3):
            coarse[p + a, p + a] += information[k, a] + smallest
        for m, a, b in ((3, 0, 1), (4, 0, 2), (5, 1, 2)):
            coarse[p + a, p + b] += information[k, m]
            coarse[p + b, p + a] += information[k, m]


@njit(nogil=True, cache=True, error_model="numpy")
def retain(inverse, information, F):
    """F (3L, 3L) float32 out: I - inverse blockdiag(information), information (L, 6)."""
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
def conditioned(shared, bend, patch, weight, normal, variance, isotropic, scale2, covariance):
    """covariance (V, 3, 3) out: the patch's (``shared``, (L, 3, 3)), for measured vertices after their own measurement.

    A plane is known along its normal to its variance and to how far the normal turns within the patch (``bend`` (L,), mean
    squared difference of two normals) where the patch may slide: the plane that was found is then a neighbour's.
    ``scale2`` (V,) multiplies the result.
    """
    for i in range(patch.shape[0]):
        P = shared[patch[i]]
        a, b, c, d, e, f = P[0, 0], P[1, 1], P[2, 2], P[0, 1], P[0, 2], P[1, 2]
        w, k = weight[i], scale2[i]
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
        covariance[i, 0, 0], covariance[i, 1, 1], covariance[i, 2, 2] = k * a, k * b, k * c
        covariance[i, 0, 1] = covariance[i, 1, 0] = k * d
        covariance[i, 0, 2] = covariance[i, 2, 0] = k * e
        covariance[i, 1, 2] = covariance[i, 2, 1] = k * f


@njit(nogil=True, cache=True, error_model="numpy")
def traces(covariance, trace):
    """trace (V,) out, of (V, 3, 3)."""
    for i in range(covariance.shape[0]):
        trace[i] = covariance[i, 0, 0] + covariance[i, 1, 1] + covariance[i, 2, 2]


@njit(nogil=True, cache=True, error_model="numpy")
def along_cloth(seen, start, neighbour, rest_length, most, distance):
    """distance (V,) out: length of the shortest path along edges at rest to a vertex that is ``seen`` (V,), m, at most ``most``.

    A queue of the vertices whose distance has changed, each in it at most once (Moore 1959).
    """
    n = seen.shape[0]
    queue, waiting = np.empty(n, np.uint32), np.zeros(n, np.bool_)
    count = first = 0
    for i in range(n):
        distance[i] = 0.0 if seen[i] else most
        if seen[i]:
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
    """Blocks of (V, 3, 3) covariance that are not finite and positive definite become those of the fallback, in place."""
    for i in range(covariance.shape[0]):
        a, b, c = covariance[i, 0, 0], covariance[i, 1, 1], covariance[i, 2, 2]
        d, e, f = covariance[i, 0, 1], covariance[i, 0, 2], covariance[i, 1, 2]
        minor = a * b - d * d
        determinant = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e)
        finite = abs(a) + abs(b) + abs(c) + abs(d) + abs(e) + abs(f) < np.inf
        if not (a > 0.0 and minor > 0.0 and determinant > 0.0 and finite):
            covariance[i] = fallback[i]

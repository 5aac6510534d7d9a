"""Stage F, covariance (paper, section 2.7): a frame's evidence by patches, and the covariance of each vertex."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.symmetric import invert3


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
    turned: np.ndarray  # (L,) squared sines of the angles between the surface and the measurements


class PatchMeans(NamedTuple):
    """Means over the vertices of each of L patches."""

    information: np.ndarray  # (L, 6) 1/m^2 of the measurements, counted as one: xx yy zz xy xz yz
    bend: np.ndarray  # (L,) 1 - |mean normal|^2 of the measurements
    motion2: np.ndarray  # (L,) m^2, mean squared motion, the garment's common one taken out
    innovation2: np.ndarray  # (L,) m^2, mean squared innovation of the measured vertices, the common one taken out
    strain2: np.ndarray  # (L,) mean squared strain
    turned: np.ndarray  # (L,) mean squared sine of the angle between surface and measurements; where there are none, of all


@njit(nogil=True, cache=True, error_model="numpy")
def sum_by_patch(position, last, prior, surface, patch, ring_strain, planes, sums):
    """Sums a frame's evidence over the vertices of each patch.

    Args:
        position, last, prior: (V, 3) metres; ``last`` is the position of a vertex that has not moved.
        surface: (V, 3) unit normals of the garment.
        patch: (V,) int32 in [0, L).
        ring_strain: (V,) mean squared strain of the edges at each vertex.
        planes: :class:`MeasuredPlanes`.
        sums: :class:`PatchSums` out.
    """
    weight, normal, variance, isotropic = planes
    size, observed, information, facing, motion, innovation, strain, turned = sums
    size[:], observed[:], strain[:], turned[:] = 0.0, 0.0, 0.0, 0.0
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
        if not isotropic:  # points have no normals
            cosine = surface[i, 0] * x + surface[i, 1] * y + surface[i, 2] * z
            turned[c] += min(max(1.0 - cosine * cosine, 0.0), 1.0)
        for a in range(3):
            d = position[i, a] - prior[i, a]
            facing[c, a] += normal[i, a]
            innovation[c, a] += d
            innovation[c, 3] += d * d


@njit(nogil=True, cache=True, error_model="numpy")
def mean_square_about_mean(sums, count, squared):
    """Mean squared distance of each patch's vectors from the mean vector of all patches.

    Args:
        sums: (L, 4) of vectors and of their squares.
        count: (L,) vectors.
        squared: (L,) out.
    """
    x = y = z = total = 0.0
    for k in range(count.shape[0]):
        x, y, z, total = x + sums[k, 0], y + sums[k, 1], z + sums[k, 2], total + count[k]
    total = max(total, 1.0)
    x, y, z = x / total, y / total, z / total
    for k in range(count.shape[0]):
        along = sums[k, 0] * x + sums[k, 1] * y + sums[k, 2] * z
        about = sums[k, 3] - 2.0 * along + count[k] * (x * x + y * y + z * z)
        squared[k] = max(about, 0.0) / max(count[k], 1.0)


@njit(nogil=True, cache=True, error_model="numpy")
def patch_means(sums, persistence, least_bend, means):
    """Means over each patch, from a frame's sums.

    Args:
        sums: :class:`PatchSums`.
        persistence: frames over which measurements repeat their error.
        least_bend: of a patch.
        means: :class:`PatchMeans` out.
    """
    size, observed, information, facing, motion, innovation, strain, turned = sums
    mean_square_about_mean(motion, size, means.motion2)
    mean_square_about_mean(innovation, observed, means.innovation2)
    mean_turned = turned.sum() / max(observed.sum(), 1.0)
    for k in range(size.shape[0]):
        n = max(observed[k], 1.0)
        for m in range(6):
            means.information[k, m] = information[k, m] / (persistence * n)
        x, y, z = facing[k, 0] / n, facing[k, 1] / n, facing[k, 2] / n
        means.bend[k] = max(1.0 - (x * x + y * y + z * z), least_bend)
        means.strain2[k] = strain[k] / size[k]
        means.turned[k] = turned[k] / n if observed[k] > 0.0 else mean_turned


@njit(nogil=True, cache=True, error_model="numpy")
def grow(covariance, kept, likeness, growth2, ceiling_sd, grown):
    """The errors of the patches after they have faded and grown, alike in all directions and together as the patches are alike.

    Args:
        covariance: (3L, 3L) float32 m^2.
        kept: share of it that has not faded.
        likeness: (L, L) float32 correlation of the patches.
        growth2: (L,) m^2 in each direction.
        ceiling_sd: metres, of the largest standard deviation; where it is larger all are scaled.
        grown: (3L, 3L) float32 m^2, out.
    """
    root, largest, share = np.sqrt(growth2).astype(np.float32), np.float32(1e-12), np.float32(kept)
    for k in range(likeness.shape[0]):
        for a in range(3):
            r = 3 * k + a
            for c in range(grown.shape[1]):
                grown[r, c] = share * covariance[r, c]
            for m in range(likeness.shape[0]):
                grown[r, 3 * m + a] += root[k] * likeness[k, m] * root[m]
            largest = max(largest, grown[r, r])
    scale = np.float32(ceiling_sd / np.sqrt(largest))
    if scale < 1.0:
        for r in range(grown.shape[0]):
            for c in range(grown.shape[1]):
                grown[r, c] *= scale * scale


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


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def subtract_product(left, right, total, p, width):
    """total -= left right, of three rows of ``left`` and ``total`` from p on, of ``total`` the first ``width`` columns.

    Columns of ``left`` whose three entries are 0 are left out. The sums stay in three rows of their own, so that the compiler
    sees that nothing overlaps and vectorises.
    """
    sums = np.zeros((3, width), np.float32)
    A, B, C = sums[0], sums[1], sums[2]
    for q in range(right.shape[0]):
        a, b, c, row = left[p, q], left[p + 1, q], left[p + 2, q], right[q]
        if abs(a) + abs(b) + abs(c) > 0.0:
            for m in range(width):
                x = row[m]
                A[m] += a * x
                B[m] += b * x
                C[m] += c * x
    for r in range(3):
        for m in range(width):
            total[p + r, m] -= sums[r, m]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def update_errors(P, G, information, updated):
    """F P F' + G M G with F = I - G M, of M the block diagonal information: how an update changes the errors of the patches.

    With X = P F' - G it is F X + G. What was not measured takes part in no product.

    Args:
        P: (3L, 3L) float32 m^2, symmetric.
        G: (3L, 3L) float32 m^2, symmetric.
        information: (L, 6) 1/m^2, xx yy zz xy xz yz.
        updated: (3L, 3L) float32 m^2, out.

    Returns:
        Whether G is finite; if not, nothing is written.
    """
    total = np.float32(0.0)
    for r in range(G.shape[0]):
        for c in range(G.shape[0]):
            total += abs(G[r, c])
    if not total < np.inf:
        return False
    product, X, n = np.empty_like(P), np.empty_like(P), P.shape[0]
    for q in range(0, n, 3):  # P M
        a, b, c, d, e, f = information[q // 3].astype(np.float32)
        for r in range(n):
            x, y, z = P[r, q], P[r, q + 1], P[r, q + 2]
            product[r, q], product[r, q + 1] = x * a + y * d + z * e, x * d + y * b + z * f
            product[r, q + 2] = x * e + y * f + z * c
    for p in range(0, n, 3):
        for r in range(p, p + 3):
            for c in range(n):
                X[r, c] = P[r, c] - G[r, c]
        subtract_product(product, G, X, p, n)
    for q in range(0, n, 3):  # M X
        a, b, c, d, e, f = information[q // 3].astype(np.float32)
        for m in range(n):
            x, y, z = X[q, m], X[q + 1, m], X[q + 2, m]
            product[q, m], product[q + 1, m] = x * a + y * d + z * e, x * d + y * b + z * f
            product[q + 2, m] = x * e + y * f + z * c
    for p in range(0, n, 3):
        for r in range(p, p + 3):
            for c in range(p + 3):
                X[r, c] += G[r, c]
        subtract_product(G, product, X, p, p + 3)
    for r in range(n):
        for c in range(r + 1):  # the result is symmetric
            updated[r, c] = updated[c, r] = X[r, c]
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def vertex_covariances(drift, share, added, bend, patch, planes, covariance):
    """Covariance of each vertex: that of its patch and more, conditioned on the vertex's own measurement.

    A plane is known along its normal to its variance and, where the patch may slide, to the turn of the normal within the patch:
    the plane that was found is then a neighbour's.

    Args:
        drift: (3L, 3L) float32 covariance of the patches, m^2.
        share: factor on it, for the vertex about its patch.
        added: (L,) m^2, in each direction.
        bend: (L,) mean squared difference of two normals of a patch.
        patch: (V,) int32 in [0, L).
        planes: :class:`MeasuredPlanes`.
        covariance: (V, 3, 3) m^2, out.
    """
    weight, normal, variance, isotropic = planes
    for i in range(patch.shape[0]):
        k = patch[i]
        p, q, r = 3 * k, 3 * k + 1, 3 * k + 2
        a, b, c = share * drift[p, p] + added[k], share * drift[q, q] + added[k], share * drift[r, r] + added[k]
        d, e, f = share * drift[p, q], share * drift[p, r], share * drift[q, r]
        w = weight[i]
        if w > 0.0 and not isotropic:
            x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
            gx, gy, gz = a * x + d * y + e * z, d * x + b * y + f * z, e * x + f * y + c * z
            along = gx * x + gy * y + gz * z
            s = 1.0 / (along + variance[i] / w + bend[k] * (a + b + c - along))
            a, b, c = a - s * gx * gx, b - s * gy * gy, c - s * gz * gz
            d, e, f = d - s * gx * gy, e - s * gx * gz, f - s * gy * gz
        elif w > 0.0:
            precision = w / variance[i]
            a, b, c, d, e, f = invert3(a, b, c, d, e, f)
            a, b, c, d, e, f = invert3(a + precision, b + precision, c + precision, d, e, f)
        covariance[i, 0, 0], covariance[i, 1, 1], covariance[i, 2, 2] = a, b, c
        covariance[i, 0, 1] = covariance[i, 1, 0] = d
        covariance[i, 0, 2] = covariance[i, 2, 0] = e
        covariance[i, 1, 2] = covariance[i, 2, 1] = f


@njit(nogil=True, cache=True, error_model="numpy")
def traces(covariance, trace):
    """Traces of (V, 3, 3) blocks, (V,) out."""
    for i in range(covariance.shape[0]):
        trace[i] = covariance[i, 0, 0] + covariance[i, 1, 1] + covariance[i, 2, 2]


@njit(nogil=True, cache=True, error_model="numpy")
def mean_and_largest_trace(covariance):
    """Mean and largest trace of (V, 3, 3) blocks; not finite where one is not."""
    total, largest = 0.0, -np.inf
    for i in range(covariance.shape[0]):
        trace = covariance[i, 0, 0] + covariance[i, 1, 1] + covariance[i, 2, 2]
        total += trace
        largest = max(largest, trace)
    return total / covariance.shape[0], largest if np.isfinite(total) else total


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

"""Preconditioned conjugate gradients on the one-rings of a mesh, for the normal equations of stage F.

Blocks are stored by columns padded to four numbers, so that the compiler makes a vector of each.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.symmetric import invert3

PIVOTS = 8  # rows of a matrix that a step of its inversion takes; written out in eliminate


class BlockMatrix(NamedTuple):
    """A symmetric matrix of 3x3 blocks on the one-rings, by columns padded to four numbers."""

    D: np.ndarray  # (V, 12) float32 1/m^2, diagonal blocks
    B: np.ndarray  # (2E, 12) float32 1/m^2, block of each entry of the one-rings
    start: np.ndarray  # (V + 1,) uint32: row i of the one-rings is [start[i], start[i + 1])
    neighbour: np.ndarray  # (2E,) uint32


class Preconditioner(NamedTuple):
    """Two levels: blocks of vertices, and aggregates of them."""

    inverse: np.ndarray  # (V, 12) float32 m^2, inverses of the diagonal blocks, stored as these are
    aggregate: np.ndarray  # (V,) int32 in [0, K)
    coarse_inverse: np.ndarray  # (3K, 3K) float32 m^2, inverse of the matrix on the aggregates


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def invert(matrix, inverse):
    """Inverse of a symmetric positive definite (n, n) matrix, float32 out. Returns whether all pivots were positive.

    Symmetric sweeps (Goodnight 1979, "A tutorial on the SWEEP operator"), PIVOTS at a time, on the lower triangle of a padded
    copy. A few hundred rows take little more than half as long as by LAPACK's spotrf and spotri.
    """
    n = matrix.shape[0]
    padded = (n + PIVOTS - 1) // PIVOTS * PIVOTS
    A = np.zeros((padded, padded), np.float32)
    for i in range(n):
        for j in range(i + 1):
            A[i, j] = matrix[i, j]
    for i in range(n, padded):
        A[i, i] = 1.0
    T, R, W = np.empty((PIVOTS, PIVOTS)), np.empty((PIVOTS, padded), np.float32), np.empty((PIVOTS, padded), np.float32)
    for first in range(0, padded, PIVOTS):
        after = first + PIVOTS
        for p in range(PIVOTS):
            for j in range(after):
                R[p, j] = A[first + p, j]
        for j in range(after, padded):
            for p in range(PIVOTS):
                R[p, j] = A[j, first + p]
        for p in range(PIVOTS):
            for q in range(p + 1):
                R[q, first + p] = R[p, first + q]
                T[p, q] = T[q, p] = R[p, first + q]
        if not sweep(T):
            return False
        for p in range(PIVOTS):
            W[p] = 0.0
            for q in range(PIVOTS):
                t = -np.float32(T[p, q])
                for j in range(padded):
                    W[p, j] += t * R[q, j]
        eliminate(A, R, W)
        for p in range(PIVOTS):
            for j in range(first):
                A[first + p, j] = W[p, j]
            for q in range(p + 1):
                A[first + p, first + q] = T[p, q]
        for i in range(after, padded):
            for p in range(PIVOTS):
                A[i, first + p] = W[p, i]
    for i in range(n):
        for j in range(i + 1):
            value = -A[i, j]
            inverse[i, j] = value
            inverse[j, i] = value
    return True


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def eliminate(A, R, W):
    """Subtracts R' W from the lower triangle of A.

    Two rows share what is read; the first of them runs over the diagonal by one.
    """
    for i in range(0, A.shape[0], 2):
        a0, a1, a2, a3, a4, a5, a6, a7 = R[0, i], R[1, i], R[2, i], R[3, i], R[4, i], R[5, i], R[6, i], R[7, i]
        k = i + 1
        b0, b1, b2, b3, b4, b5, b6, b7 = R[0, k], R[1, k], R[2, k], R[3, k], R[4, k], R[5, k], R[6, k], R[7, k]
        for j in range(i + 2):
            w0, w1, w2, w3, w4, w5, w6, w7 = W[0, j], W[1, j], W[2, j], W[3, j], W[4, j], W[5, j], W[6, j], W[7, j]
            A[i, j] -= a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3 + a4 * w4 + a5 * w5 + a6 * w6 + a7 * w7
            A[k, j] -= b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3 + b4 * w4 + b5 * w5 + b6 * w6 + b7 * w7


@njit(nogil=True, cache=True, error_model="numpy")
def sweep(T):
    """Minus the inverse of a small symmetric matrix, in place; False where a pivot is not positive or not finite."""
    n = T.shape[0]
    for k in range(n):
        d = T[k, k]
        if not 0.0 < d < np.inf:
            return False
        for i in range(n):
            if i != k:
                f = T[i, k] / d
                for j in range(n):
                    if j != k:
                        T[i, j] -= f * T[k, j]
        for j in range(n):
            T[k, j] /= d
            T[j, k] = T[k, j]
        T[k, k] = -1.0 / d
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def pack(D, packed, inverse):
    """Stores blocks (V, 3, 3), symmetric and positive definite, and their inverses by columns and padded, (V, 12) float32 out."""
    for i in range(D.shape[0]):
        a, b, c, d, e, f = D[i, 0, 0], D[i, 1, 1], D[i, 2, 2], D[i, 0, 1], D[i, 0, 2], D[i, 1, 2]
        set_columns(packed[i], a, b, c, d, e, f)
        a, b, c, d, e, f = invert3(a, b, c, d, e, f)
        set_columns(inverse[i], a, b, c, d, e, f)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def set_columns(out, a, b, c, d, e, f):
    """[[a, d, e], [d, b, f], [e, f, c]] by columns, padded."""
    out[0], out[1], out[2], out[3] = a, d, e, 0.0
    out[4], out[5], out[6], out[7] = d, b, f, 0.0
    out[8], out[9], out[10], out[11] = e, f, c, 0.0


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def coarsen(D, B, start, neighbour, aggregate, coarse):
    """P' A P, (3K, 3K) out, with P the piecewise constant interpolation from K aggregates to vertices.

    Args:
        D: (V, 3, 3) diagonal blocks of A.
        B, start, neighbour: of :class:`BlockMatrix`.
        aggregate: (V,) of each vertex.
        coarse: out.
    """
    coarse[:] = 0.0
    for i in range(D.shape[0]):
        p = 3 * aggregate[i]
        for a in range(3):
            for b in range(3):
                coarse[p + a, p + b] += D[i, a, b]
        for e in range(start[i], start[i + 1]):
            q = 3 * aggregate[neighbour[e]]
            for a in range(3):
                for b in range(3):
                    coarse[p + a, q + b] += B[e, 4 * b + a]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def multiply(matrix, v, out):
    """out = A v, both (V, 4) padded, A a :class:`BlockMatrix`. Returns v . A v.

    There are three sums, one per column of the blocks, since independent sums run in parallel.
    """
    D, B, start, neighbour = matrix
    total = 0.0
    for i in range(v.shape[0]):
        px, py, pz = v[i, 0], v[i, 1], v[i, 2]
        ax, ay, az, aw = D[i, 0] * px, D[i, 1] * px, D[i, 2] * px, D[i, 3] * px
        bx, by, bz, bw = D[i, 4] * py, D[i, 5] * py, D[i, 6] * py, D[i, 7] * py
        cx, cy, cz, cw = D[i, 8] * pz, D[i, 9] * pz, D[i, 10] * pz, D[i, 11] * pz
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            x, y, z = v[j, 0], v[j, 1], v[j, 2]
            ax += B[e, 0] * x
            ay += B[e, 1] * x
            az += B[e, 2] * x
            aw += B[e, 3] * x
            bx += B[e, 4] * y
            by += B[e, 5] * y
            bz += B[e, 6] * y
            bw += B[e, 7] * y
            cx += B[e, 8] * z
            cy += B[e, 9] * z
            cz += B[e, 10] * z
            cw += B[e, 11] * z
        ax, ay, az, aw = ax + bx + cx, ay + by + cy, az + bz + cz, aw + bw + cw
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = ax, ay, az, aw
        total += px * ax + py * ay + pz * az
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def gather(r, aggregate, padded, gathered):
    """gathered (3K,) out: P' r, the sums of (V, 4) r over the aggregates; ``padded`` (K, 4) is workspace."""
    padded[:] = 0.0
    for i in range(r.shape[0]):
        k = np.uint64(aggregate[i])
        x, y, z, w = padded[k, 0], padded[k, 1], padded[k, 2], padded[k, 3]
        padded[k, 0], padded[k, 1], padded[k, 2], padded[k, 3] = x + r[i, 0], y + r[i, 1], z + r[i, 2], w + r[i, 3]
    for k in range(padded.shape[0]):
        gathered[3 * k], gathered[3 * k + 1], gathered[3 * k + 2] = padded[k, 0], padded[k, 1], padded[k, 2]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def precondition(preconditioner, r, gathered, spread, z):
    """z = blockdiag(A)^-1 r + P (P' A P)^-1 P' r: two-level additive Schwarz. Returns r . z.

    Args:
        preconditioner: :class:`Preconditioner`.
        r, z: (V, 4) float32 in and out, padded.
        gathered: (3K,) float32, P' r.
        spread: (K, 4) float32 workspace, padded with zeros.
    """
    inverse, aggregate, coarse_inverse = preconditioner
    for i in range(coarse_inverse.shape[0]):
        product = np.float32(0.0)
        for j in range(gathered.shape[0]):
            product += coarse_inverse[i, j] * gathered[j]
        spread[i // 3, i % 3] = product
    along_x = along_y = along_z = 0.0
    for i in range(r.shape[0]):
        k = np.uint64(aggregate[i])
        x, y, w = r[i, 0], r[i, 1], r[i, 2]
        zx = inverse[i, 0] * x + inverse[i, 4] * y + inverse[i, 8] * w + spread[k, 0]
        zy = inverse[i, 1] * x + inverse[i, 5] * y + inverse[i, 9] * w + spread[k, 1]
        zz = inverse[i, 2] * x + inverse[i, 6] * y + inverse[i, 10] * w + spread[k, 2]
        zw = inverse[i, 3] * x + inverse[i, 7] * y + inverse[i, 11] * w + spread[k, 3]
        z[i, 0], z[i, 1], z[i, 2], z[i, 3] = zx, zy, zz, zw
        along_x += x * zx
        along_y += y * zy
        along_z += w * zz
    return along_x + along_y + along_z


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def advance(step, beta, z, Az, p, Ap, delta, r):
    """p = z + beta p and A p alike, delta += step p, r -= step A p; (4V,) float32 each."""
    for i in range(z.shape[0]):
        direction, product = z[i] + beta * p[i], Az[i] + beta * Ap[i]
        p[i], Ap[i] = direction, product
        delta[i] += step * direction
        r[i] -= step * product


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def conjugate_gradients(matrix, preconditioner, force, iterations, tolerance, delta):
    """Solves A delta = force by preconditioned conjugate gradients from zero, in float32 with float64 sums.

    A correction needs few digits: the residual of the MAP problem is formed anew, in float64, before each solve. The products A p
    follow p by their recurrence, so that all vectors advance in one pass over memory (Chronopoulos and Gear 1989, "s-step
    iterative methods for symmetric linear systems"). Returns the number of iterations done.

    Args:
        matrix: A, :class:`BlockMatrix`.
        preconditioner: :class:`Preconditioner`.
        force: (V, 4) 1/m, padded.
        iterations: limit.
        tolerance: factor by which the preconditioned residual norm falls before the iteration stops.
        delta: (V, 4) float32 metres out, padded.
    """
    n, k = force.shape[0], preconditioner.coarse_inverse.shape[0] // 3
    work, gathered = np.zeros((5, n, 4), np.float32), np.empty(3 * k, np.float32)
    padded, spread = np.zeros((k, 4), np.float32), np.zeros((k, 4), np.float32)
    r, z, Az = work[0], work[1], work[2]
    flat_delta, flat = delta.reshape(-1), work.reshape((5, 4 * n))
    for i in range(n):
        for a in range(4):
            delta[i, a] = 0.0
            r[i, a] = force[i, a]
    first = rz = step = 0.0
    for iteration in range(iterations + 1):
        gather(r, preconditioner.aggregate, padded, gathered)
        new = precondition(preconditioner, r, gathered, spread, z)
        if iteration == 0:
            first = new
        if iteration == iterations or not new > tolerance * tolerance * first:
            return iteration
        beta = new / rz if iteration > 0 else 0.0
        curvature = multiply(matrix, z, Az)
        if iteration > 0:
            curvature -= beta * new / step
        if not curvature > 0.0:
            return iteration
        step, rz = new / curvature, new
        advance(np.float32(step), np.float32(beta), flat[1], flat[2], flat[3], flat[4], flat_delta, flat[0])
    return iterations

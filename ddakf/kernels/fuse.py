"""Stage F, fusion update (paper, sections 2.4 and 2.8): the normal equations of the MAP problem and their solution.

A is stored as 3x3 blocks on the mesh's one-rings: the diagonal ones in D, the others in B, in the rows of the adjacency. The
solver stores blocks by columns padded to four numbers, so that the compiler makes a vector of each.
"""

from math import sqrt
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


@njit(nogil=True, cache=True, error_model="numpy")
def add_prior(position, prior, information, D, force):
    """Adds the prior of each vertex: D += I_i and force += I_i (prior - x).

    Args:
        position: x, (V, 3) or wider, metres.
        prior: (V, 3) metres.
        information: I, (V, 3, 3) 1/m^2.
        D: (V, 3, 3) diagonal blocks of A, 1/m^2, added to.
        force: (V, 3) or wider, 1/m, added to.
    """
    for i in range(position.shape[0]):
        dx, dy, dz = prior[i, 0] - position[i, 0], prior[i, 1] - position[i, 1], prior[i, 2] - position[i, 2]
        for a in range(3):
            force[i, a] += information[i, a, 0] * dx + information[i, a, 1] * dy + information[i, a, 2] * dz
            for b in range(3):
                D[i, a, b] += information[i, a, b]


@njit(nogil=True, cache=True, error_model="numpy")
def add_planes(position, target, normal, tangential, weight, variance, D, force):
    """Adds plane-aligned measurements.

    Args:
        position: (V, 3) or wider, metres.
        target, normal: (V, 3) metres, unit.
        tangential, variance: (V,) m^2, in the plane and along the normal.
        weight: (V,), 0 where there is no measurement.
        D, force: as for :func:`add_prior`.
    """
    for i in range(position.shape[0]):
        w = weight[i]
        if w <= 0.0:
            continue
        along = w / variance[i]
        across = w / tangential[i]
        dx, dy, dz = target[i, 0] - position[i, 0], target[i, 1] - position[i, 1], target[i, 2] - position[i, 2]
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        d = nx * dx + ny * dy + nz * dz
        k = along - across
        force[i, 0] += across * dx + k * d * nx
        force[i, 1] += across * dy + k * d * ny
        force[i, 2] += across * dz + k * d * nz
        D[i, 0, 0] += across + k * nx * nx
        D[i, 1, 1] += across + k * ny * ny
        D[i, 2, 2] += across + k * nz * nz
        D[i, 0, 1] += k * nx * ny
        D[i, 1, 0] += k * nx * ny
        D[i, 0, 2] += k * nx * nz
        D[i, 2, 0] += k * nx * nz
        D[i, 1, 2] += k * ny * nz
        D[i, 2, 1] += k * ny * nz


@njit(nogil=True, cache=True, error_model="numpy")
def add_single(vertex, residual, jacobian, weight, stiffness, D, force):
    """Adds constraints on one vertex each (collision): their force and their blocks.

    Args:
        vertex: (C, 1).
        residual, jacobian, weight: (C,), (C, 1, 3), (C,) of the constraints.
        stiffness: factor on the weights.
        D, force: as for :func:`add_prior`.
    """
    for c in range(vertex.shape[0]):
        k = stiffness * weight[c]
        if k == 0.0:
            continue
        i = vertex[c, 0]
        for a in range(3):
            force[i, a] -= k * residual[c] * jacobian[c, 0, a]
            for b in range(3):
                D[i, a, b] += k * jacobian[c, 0, a] * jacobian[c, 0, b]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def add_coupling(start, neighbour, edge, blocks, weight, own, D, B):
    """Fills the rows of B with the blocks of the edges less w I, and adds to D the blocks of the vertices less the row's sum.

    No energy that couples vertices changes when all move alike, so that the rows of its matrix add up to zero.

    Args:
        start, neighbour, edge: the one-rings.
        blocks: (E, 9) float32, of each edge i < j by columns.
        weight: w, of all edges alike.
        own: (V, 3, 3) symmetric, blocks of terms on single vertices.
        D: (V, 3, 3) in and out, added to.
        B: (2E, 12) float32 out.
    """
    w, zero = np.float32(weight), np.float32(0.0)
    for i in range(D.shape[0]):
        xx = yy = zz = xy = xz = yz = zero
        for e in range(start[i], start[i + 1]):
            block = blocks[edge[e]]
            x0, y0, z0 = block[0] - w, block[1], block[2]
            x1, y1, z1 = block[3], block[4] - w, block[5]
            x2, y2, z2 = block[6], block[7], block[8] - w
            if neighbour[e] < i:
                y0, x1 = x1, y0
                z0, x2 = x2, z0
                z1, y2 = y2, z1
            B[e, 0], B[e, 1], B[e, 2], B[e, 3] = x0, y0, z0, zero
            B[e, 4], B[e, 5], B[e, 6], B[e, 7] = x1, y1, z1, zero
            B[e, 8], B[e, 9], B[e, 10], B[e, 11] = x2, y2, z2, zero
            xx += x0
            yy += y1
            zz += z2
            xy += y0 + x1
            xz += z0 + x2
            yz += z1 + y2
        xy, xz, yz = 0.5 * xy, 0.5 * xz, 0.5 * yz
        D[i, 0, 0] += own[i, 0, 0] - xx
        D[i, 1, 1] += own[i, 1, 1] - yy
        D[i, 2, 2] += own[i, 2, 2] - zz
        xy, xz, yz = own[i, 0, 1] - xy, own[i, 0, 2] - xz, own[i, 1, 2] - yz
        D[i, 0, 1] += xy
        D[i, 1, 0] += xy
        D[i, 0, 2] += xz
        D[i, 2, 0] += xz
        D[i, 1, 2] += yz
        D[i, 2, 1] += yz


@njit(nogil=True, cache=True, error_model="numpy")
def invert_blocks(D, added, inverse):
    """Inverse of D + ``added`` I, of symmetric positive definite 3x3 blocks, (V, 3, 3) each."""
    for i in range(D.shape[0]):
        a, b, c = D[i, 0, 0] + added, D[i, 1, 1] + added, D[i, 2, 2] + added
        a, b, c, d, e, f = invert3(a, b, c, D[i, 0, 1], D[i, 0, 2], D[i, 1, 2])
        inverse[i, 0, 0], inverse[i, 1, 1], inverse[i, 2, 2] = a, b, c
        inverse[i, 0, 1] = inverse[i, 1, 0] = d
        inverse[i, 0, 2] = inverse[i, 2, 0] = e
        inverse[i, 1, 2] = inverse[i, 2, 1] = f


@njit(nogil=True, cache=True, error_model="numpy")
def limit(step, longest, limited):
    """Shortens the rows of (V, 4) ``step`` to at most ``longest`` metres, ``limited`` (V, 3) out.

    Returns the sum of the squared lengths before, m^2.
    """
    total = 0.0
    for i in range(step.shape[0]):
        x, y, z = np.float64(step[i, 0]), np.float64(step[i, 1]), np.float64(step[i, 2])
        squared = x * x + y * y + z * z
        total += squared
        scale = longest / sqrt(squared) if squared > longest * longest else 1.0
        limited[i, 0], limited[i, 1], limited[i, 2] = scale * x, scale * y, scale * z
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def secant(position, delta, last_position, last_delta, longest, step):
    """step = delta - s (change of position + change of delta), s being the regression of delta on its change.

    Args:
        position, delta: (V, 3) estimate and correction of this pass, metres.
        last_position, last_delta: of the pass before.
        longest: bound of |s|, passes.
        step: (V, 3) out, metres.
    """
    along = length = 0.0
    for i in range(delta.shape[0]):
        for a in range(3):
            turn = delta[i, a] - last_delta[i, a]
            length += turn * turn
            along += turn * delta[i, a]
    share = min(max(along / length, -longest), longest) if length > 0.0 else 0.0
    for i in range(delta.shape[0]):
        for a in range(3):
            step[i, a] = delta[i, a] - share * (position[i, a] - last_position[i, a] + delta[i, a] - last_delta[i, a])


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
def precondition(preconditioner, r, gathered, spread, z):
    """z = blockdiag(A)^-1 r + P (P' A P)^-1 P' r: two-level additive Schwarz. Returns r . z.

    Args:
        preconditioner: :class:`Preconditioner`.
        r, z: (V, 4) float32 in and out, padded.
        gathered, spread: (3K,) float32 workspace.
    """
    inverse, aggregate, coarse_inverse = preconditioner
    gathered[:] = 0.0
    for i in range(r.shape[0]):
        p = 3 * aggregate[i]
        gathered[p] += r[i, 0]
        gathered[p + 1] += r[i, 1]
        gathered[p + 2] += r[i, 2]
    np.dot(coarse_inverse, gathered, spread)
    total = 0.0
    for i in range(r.shape[0]):
        p = 3 * aggregate[i]
        x, y, w = r[i, 0], r[i, 1], r[i, 2]
        zx = inverse[i, 0] * x + inverse[i, 4] * y + inverse[i, 8] * w + spread[p]
        zy = inverse[i, 1] * x + inverse[i, 5] * y + inverse[i, 9] * w + spread[p + 1]
        zz = inverse[i, 2] * x + inverse[i, 6] * y + inverse[i, 10] * w + spread[p + 2]
        z[i, 0], z[i, 1], z[i, 2], z[i, 3] = zx, zy, zz, 0.0
        total += x * zx + y * zy + w * zz
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def conjugate_gradients(matrix, preconditioner, force, iterations, tolerance, delta):
    """Solves A delta = force by preconditioned conjugate gradients from zero, in float32 with float64 sums.

    A correction needs few digits: the residual of the MAP problem is formed anew, in float64, before each solve. Returns the
    number of iterations done.

    Args:
        matrix: A, :class:`BlockMatrix`.
        preconditioner: :class:`Preconditioner`.
        force: (V, 4) 1/m, padded.
        iterations: limit.
        tolerance: factor by which the preconditioned residual norm falls before the iteration stops.
        delta: (V, 4) float32 metres out, padded.
    """
    n, k = force.shape[0], preconditioner.coarse_inverse.shape[0]
    work, gathered, spread = np.empty((4, n, 4), np.float32), np.empty(k, np.float32), np.empty(k, np.float32)
    r, z, p, q = work[0], work[1], work[2], work[3]
    for i in range(n):
        for a in range(4):
            delta[i, a] = 0.0
            r[i, a] = force[i, a]
    rz = precondition(preconditioner, r, gathered, spread, z)
    p[:] = z
    first = rz
    if not first > 0.0:
        return 0
    for iteration in range(iterations):
        pq = multiply(matrix, p, q)
        if not pq > 0.0:
            return iteration
        step = np.float32(rz / pq)
        for i in range(n):
            for a in range(4):
                delta[i, a] += step * p[i, a]
                r[i, a] -= step * q[i, a]
        new = precondition(preconditioner, r, gathered, spread, z)
        if new <= tolerance * tolerance * first:
            return iteration + 1
        beta = np.float32(new / rz)
        rz = new
        for i in range(n):
            for a in range(4):
                p[i, a] = z[i, a] + beta * p[i, a]
    return iterations


@njit(nogil=True, cache=True, error_model="numpy")
def condition(prior, shift, velocity, posterior):
    """Velocity and blocks of each 6-vector after its position is known, see ``ddakf.stages.fuse.condition``.

    Args:
        prior: ``CovarianceBlocks``.
        shift: (V, 3) posterior minus prior position, metres.
        velocity: (V, 3) m/s in: prior; out: posterior.
        posterior: ``CovarianceBlocks``, pp in, pu and uu out.
    """
    P_pp, P_pu, P_uu = prior
    posterior_pp, posterior_pu, posterior_uu = posterior
    G = np.empty((3, 3))
    change = np.empty((3, 3))
    for i in range(P_pp.shape[0]):
        a, b, c, d, e, f = invert3(P_pp[i, 0, 0], P_pp[i, 1, 1], P_pp[i, 2, 2], P_pp[i, 0, 1], P_pp[i, 0, 2], P_pp[i, 1, 2])
        for r in range(3):
            x, y, z = P_pu[i, 0, r], P_pu[i, 1, r], P_pu[i, 2, r]
            G[r, 0] = x * a + y * d + z * e
            G[r, 1] = x * d + y * b + z * f
            G[r, 2] = x * e + y * f + z * c
            velocity[i, r] += G[r, 0] * shift[i, 0] + G[r, 1] * shift[i, 1] + G[r, 2] * shift[i, 2]
            for s in range(3):
                change[r, s] = posterior_pp[i, r, s] - P_pp[i, r, s]
        for r in range(3):
            for s in range(3):
                posterior_pu[i, r, s] = (
                    posterior_pp[i, r, 0] * G[s, 0] + posterior_pp[i, r, 1] * G[s, 1] + posterior_pp[i, r, 2] * G[s, 2]
                )
        for r in range(3):
            x = G[r, 0] * change[0, 0] + G[r, 1] * change[1, 0] + G[r, 2] * change[2, 0]
            y = G[r, 0] * change[0, 1] + G[r, 1] * change[1, 1] + G[r, 2] * change[2, 1]
            z = G[r, 0] * change[0, 2] + G[r, 1] * change[1, 2] + G[r, 2] * change[2, 2]
            for s in range(r + 1):
                value = P_uu[i, r, s] + x * G[s, 0] + y * G[s, 1] + z * G[s, 2]
                posterior_uu[i, r, s] = value
                posterior_uu[i, s, r] = value

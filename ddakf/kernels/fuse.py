"""Stage F, fusion update (paper, sections 2.4 and 2.8): the normal equations of the MAP problem and their solution.

A is stored as 3x3 blocks on the mesh's one-rings: the diagonal ones in D, the others in B, in the rows of the adjacency.
"""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def add_prior(position, prior, information, D, force):
    """Adds the prior of each vertex: D += I_i and force += I_i (prior - x)."""
    for i in range(position.shape[0]):
        dx, dy, dz = prior[i, 0] - position[i, 0], prior[i, 1] - position[i, 1], prior[i, 2] - position[i, 2]
        for a in range(3):
            force[i, a] += information[i, a, 0] * dx + information[i, a, 1] * dy + information[i, a, 2] * dz
            for b in range(3):
                D[i, a, b] += information[i, a, b]


@njit(nogil=True, cache=True, error_model="numpy")
def add_planes(position, target, normal, tangential, weight, variance, D, force):
    """Adds plane-aligned measurements of variance r along the normal and ``tangential`` (m^2) in the plane, times weight."""
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
    """Adds constraints on one vertex each (collision): their force and their blocks."""
    for c in range(vertex.shape[0]):
        k = stiffness * weight[c]
        if k == 0.0:
            continue
        i = vertex[c, 0]
        for a in range(3):
            force[i, a] -= k * residual[c] * jacobian[c, 0, a]
            for b in range(3):
                D[i, a, b] += k * jacobian[c, 0, a] * jacobian[c, 0, b]


@njit(nogil=True, cache=True, error_model="numpy")
def add_hinges(stencil, residual, jacobian, weight, stiffness, D, force):
    """Adds bending: its exact force, and as its matrix the block-diagonal majoriser.

    A hinge's k J^T J couples vertices that are not neighbours. 4 k blockdiag(J_s^T J_s) is nowhere smaller (Cauchy-Schwarz on
    its four terms), so the step stays a descent step and A keeps the sparsity of the one-rings.
    """
    for c in range(stencil.shape[0]):
        k = stiffness * weight[c]
        for s in range(4):
            i = stencil[c, s]
            x, y, z = jacobian[c, s, 0], jacobian[c, s, 1], jacobian[c, s, 2]
            force[i, 0] -= k * residual[c] * x
            force[i, 1] -= k * residual[c] * y
            force[i, 2] -= k * residual[c] * z
            m = 4.0 * k
            D[i, 0, 0] += m * x * x
            D[i, 1, 1] += m * y * y
            D[i, 2, 2] += m * z * z
            D[i, 0, 1] += m * x * y
            D[i, 1, 0] += m * x * y
            D[i, 0, 2] += m * x * z
            D[i, 2, 0] += m * x * z
            D[i, 1, 2] += m * y * z
            D[i, 2, 1] += m * y * z


@njit(nogil=True, cache=True, error_model="numpy")
def add_edges(start, weight, D, B):
    """Starts B with the edges' -w I, and adds their w I to D."""
    for i in range(D.shape[0]):
        s = 0.0
        for e in range(start[i], start[i + 1]):
            w = weight[e]
            s += w
            B[e, :, :] = 0.0
            B[e, 0, 0] = -w
            B[e, 1, 1] = -w
            B[e, 2, 2] = -w
        D[i, 0, 0] += s
        D[i, 1, 1] += s
        D[i, 2, 2] += s


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def add_triangles(
    faces, slot, stretch_r, stretch_J, stretch_w, stretch_k, shear_r, shear_J, shear_w, shear_k, D, B, force
):
    """Adds stretch (two constraints per face, warp first) and shear (one): force and Gauss-Newton blocks.

    ``slot`` (F, 3, 3) holds, for corners s and t of a face, the row entry of that pair. The three constraints of a face share
    their blocks, so that each is read and written once.
    """
    n = faces.shape[0]
    for f in range(n):
        ku, kv, kh = stretch_k * stretch_w[f], stretch_k * stretch_w[f + n], shear_k * shear_w[f]
        fu, fv, fh = ku * stretch_r[f], kv * stretch_r[f + n], kh * shear_r[f]
        U, W, H = stretch_J[f], stretch_J[f + n], shear_J[f]
        for s in range(3):
            i = faces[f, s]
            for a in range(3):
                u, w, h = ku * U[s, a], kv * W[s, a], kh * H[s, a]
                force[i, a] -= fu * U[s, a] + fv * W[s, a] + fh * H[s, a]
                for b in range(3):
                    D[i, a, b] += u * U[s, b] + w * W[s, b] + h * H[s, b]
                for t in range(s):
                    e, d = slot[f, s, t], slot[f, t, s]
                    for b in range(3):
                        x = np.float32(u * U[t, b] + w * W[t, b] + h * H[t, b])
                        B[e, a, b] += x
                        B[d, b, a] += x


@njit(nogil=True, cache=True, error_model="numpy")
def invert_blocks(D, inverse):
    """Inverse of symmetric positive definite 3x3 blocks, (V, 3, 3) each."""
    for i in range(D.shape[0]):
        a, b, c = D[i, 0, 0], D[i, 1, 1], D[i, 2, 2]
        d, e, f = D[i, 0, 1], D[i, 0, 2], D[i, 1, 2]
        A = b * c - f * f
        B = e * f - d * c
        C = d * f - b * e
        r = 1.0 / (a * A + d * B + e * C)
        inverse[i, 0, 0] = A * r
        inverse[i, 0, 1] = B * r
        inverse[i, 1, 0] = B * r
        inverse[i, 0, 2] = C * r
        inverse[i, 2, 0] = C * r
        inverse[i, 1, 1] = (a * c - e * e) * r
        inverse[i, 1, 2] = (e * d - a * f) * r
        inverse[i, 2, 1] = (e * d - a * f) * r
        inverse[i, 2, 2] = (a * b - d * d) * r


@njit(nogil=True, cache=True, error_model="numpy")
def coarsen(D, B, start, neighbour, cluster, coarse):
    """coarse (3K, 3K) out: P' A P with P the piecewise constant interpolation from clusters (V,) to vertices."""
    coarse[:] = 0.0
    for i in range(D.shape[0]):
        p = 3 * cluster[i]
        for a in range(3):
            for b in range(3):
                coarse[p + a, p + b] += D[i, a, b]
        for e in range(start[i], start[i + 1]):
            q = 3 * cluster[neighbour[e]]
            for a in range(3):
                for b in range(3):
                    coarse[p + a, q + b] += B[e, a, b]


@njit(nogil=True, cache=True, error_model="numpy")
def multiply(D, B, start, neighbour, v, out):
    """out = A v, all (V, 3)."""
    for i in range(v.shape[0]):
        x, y, z = v[i, 0], v[i, 1], v[i, 2]
        ox = D[i, 0, 0] * x + D[i, 0, 1] * y + D[i, 0, 2] * z
        oy = D[i, 1, 0] * x + D[i, 1, 1] * y + D[i, 1, 2] * z
        oz = D[i, 2, 0] * x + D[i, 2, 1] * y + D[i, 2, 2] * z
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            x, y, z = v[j, 0], v[j, 1], v[j, 2]
            ox += B[e, 0, 0] * x + B[e, 0, 1] * y + B[e, 0, 2] * z
            oy += B[e, 1, 0] * x + B[e, 1, 1] * y + B[e, 1, 2] * z
            oz += B[e, 2, 0] * x + B[e, 2, 1] * y + B[e, 2, 2] * z
        out[i, 0] = ox
        out[i, 1] = oy
        out[i, 2] = oz


@njit(nogil=True, cache=True, error_model="numpy")
def precondition(inverse, cluster, coarse_inverse, r, gathered, spread, z):
    """z = blockdiag(A)^-1 r + P (P' A P)^-1 P' r: two-level additive Schwarz."""
    gathered[:] = 0.0
    for i in range(r.shape[0]):
        p = 3 * cluster[i]
        gathered[p] += r[i, 0]
        gathered[p + 1] += r[i, 1]
        gathered[p + 2] += r[i, 2]
    np.dot(coarse_inverse, gathered, spread)
    for i in range(r.shape[0]):
        p = 3 * cluster[i]
        x, y, w = r[i, 0], r[i, 1], r[i, 2]
        z[i, 0] = inverse[i, 0, 0] * x + inverse[i, 0, 1] * y + inverse[i, 0, 2] * w + spread[p]
        z[i, 1] = inverse[i, 1, 0] * x + inverse[i, 1, 1] * y + inverse[i, 1, 2] * w + spread[p + 1]
        z[i, 2] = inverse[i, 2, 0] * x + inverse[i, 2, 1] * y + inverse[i, 2, 2] * w + spread[p + 2]


@njit(nogil=True, cache=True, error_model="numpy")
def conjugate_gradients(
    D, B, start, neighbour, inverse, cluster, coarse_inverse, force, iterations, tolerance, work, gathered, spread, delta
):
    """Solves A delta = force by preconditioned conjugate gradients from zero, in float32 with float64 sums.

    A correction needs few digits: the residual of the MAP problem is formed anew, in float64, before each solve. Stops after
    ``iterations``, or when the preconditioned residual norm has fallen by ``tolerance``. Returns the iterations done.

    Args:
        D, B: (V, 3, 3), (2E, 3, 3) float32 blocks of A.
        inverse, cluster, coarse_inverse: the preconditioner, float32.
        force: (V, 3).
        work, gathered, spread: (4, V, 3), (3K,), (3K,) float32 scratch.
        delta: (V, 3) float32 out.
    """
    r, z, p, q = work[0], work[1], work[2], work[3]
    n = force.shape[0]
    for i in range(n):
        for a in range(3):
            delta[i, a] = 0.0
            r[i, a] = force[i, a]
    precondition(inverse, cluster, coarse_inverse, r, gathered, spread, z)
    rz = 0.0
    for i in range(n):
        for a in range(3):
            p[i, a] = z[i, a]
            rz += r[i, a] * z[i, a]
    first = rz
    if not first > 0.0:
        return 0
    for iteration in range(iterations):
        multiply(D, B, start, neighbour, p, q)
        pq = 0.0
        for i in range(n):
            pq += p[i, 0] * q[i, 0] + p[i, 1] * q[i, 1] + p[i, 2] * q[i, 2]
        if not pq > 0.0:
            return iteration
        step = np.float32(rz / pq)
        for i in range(n):
            for a in range(3):
                delta[i, a] += step * p[i, a]
                r[i, a] -= step * q[i, a]
        precondition(inverse, cluster, coarse_inverse, r, gathered, spread, z)
        new = 0.0
        for i in range(n):
            new += r[i, 0] * z[i, 0] + r[i, 1] * z[i, 1] + r[i, 2] * z[i, 2]
        if new <= tolerance * tolerance * first:
            return iteration + 1
        beta = np.float32(new / rz)
        rz = new
        for i in range(n):
            for a in range(3):
                p[i, a] = z[i, a] + beta * p[i, a]
    return iterations


@njit(nogil=True, cache=True, error_model="numpy")
def discount(D, information, prior_share, weight, normal, variance, tangential, measurement_share):
    """Takes from D (V, 3, 3), in place, the given shares of the prior's and of the measurements' information."""
    for i in range(D.shape[0]):
        k = prior_share[i]
        along = across = 0.0
        if weight[i] > 0.0:
            across = measurement_share * weight[i] / tangential[i]
            along = measurement_share * weight[i] / variance[i] - across
        for a in range(3):
            for b in range(3):
                D[i, a, b] -= k * information[i, a, b] + along * normal[i, a] * normal[i, b]
            D[i, a, a] -= across


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def invert3(a, b, c, d, e, f):
    """Inverse of [[a, d, e], [d, b, f], [e, f, c]] as the same six numbers."""
    A = b * c - f * f
    B = e * f - d * c
    C = d * f - b * e
    r = 1.0 / (a * A + d * B + e * C)
    return A * r, (a * c - e * e) * r, (a * b - d * d) * r, B * r, C * r, (e * d - a * f) * r


@njit(nogil=True, cache=True, error_model="numpy")
def condition(P_pp, P_pu, P_uu, shift, posterior_pp, velocity, posterior_pu, posterior_uu):
    """Velocity and blocks of each 6-vector once its position is known: see ``ddakf.fuse.condition``.

    Args:
        P_pp, P_pu, P_uu: (V, 3, 3) prior blocks.
        shift: (V, 3) posterior minus prior position.
        posterior_pp: (V, 3, 3).
        velocity: (V, 3) in: prior; out: posterior.
        posterior_pu, posterior_uu: (V, 3, 3) out.
    """
    G = np.empty((3, 3))
    change = np.empty((3, 3))
    for i in range(P_pp.shape[0]):
        a, b, c, d, e, f = invert3(
            P_pp[i, 0, 0], P_pp[i, 1, 1], P_pp[i, 2, 2], P_pp[i, 0, 1], P_pp[i, 0, 2], P_pp[i, 1, 2]
        )
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

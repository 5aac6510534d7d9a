"""Stage F, fusion update (paper, sections 2.4 and 2.8): the normal equations of the MAP problem, and what follows their solution.

A is stored as 3x3 blocks on the mesh's one-rings: the diagonal ones in D, the others in B, in the rows of the adjacency. The
solver is in :mod:`ddakf.kernels.conjugate_gradients`.
"""

from math import sqrt

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.symmetric import invert3

MOST_GAIN = 60.0  # 1/s, of a velocity over a change of position, root mean square over the axes


@njit(nogil=True, cache=True, error_model="numpy")
def begin(position, prior, information, bending, bend_force, D, force):
    """Bending and the prior of each vertex: D = H_i + I_i and force = f_i + I_i (prior - x), out.

    Args:
        position: x, (V, 3) or wider, metres.
        prior: (V, 3) metres.
        information: I, (V, 3, 3) 1/m^2.
        bending, bend_force: H, (V, 3, 3) 1/m^2, and f, (V, 4) padded, 1/m.
        D: (V, 3, 3) out, diagonal blocks of A, 1/m^2.
        force: (V, 4) out, padded, 1/m.
    """
    for i in range(position.shape[0]):
        dx, dy, dz = prior[i, 0] - position[i, 0], prior[i, 1] - position[i, 1], prior[i, 2] - position[i, 2]
        for a in range(3):
            force[i, a] = bend_force[i, a] + (information[i, a, 0] * dx + information[i, a, 1] * dy + information[i, a, 2] * dz)
            for b in range(3):
                D[i, a, b] = bending[i, a, b] + information[i, a, b]
        force[i, 3] = 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def add_planes(position, target, normal, tangential, weight, variance, D, force):
    """Adds plane-aligned measurements.

    Args:
        position: (V, 3) or wider, metres.
        target, normal: (V, 3) metres, unit.
        tangential, variance: (V,) m^2, in the plane and along the normal.
        weight: (V,), 0 where there is no measurement.
        D, force: as for :func:`begin`, added to.
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
        D, force: as for :func:`begin`, added to.
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
    """Fills the rows of B with the blocks of the edges less w I, and D with the blocks of the vertices less the row's sum.

    No energy that couples vertices changes when all move alike, so that the rows of its matrix add up to zero.

    Args:
        start, neighbour, edge: the one-rings.
        blocks: (E, 12) float32, of each edge i < j by columns, padded.
        weight: (V,), w of an edge is the mean of its ends'.
        own: (V, 3, 3) symmetric, blocks of terms on single vertices.
        D: (V, 3, 3) out; it may be ``own``.
        B: (2E, 12) float32 out.
    """
    zero = np.float32(0.0)
    for i in range(D.shape[0]):
        xx = yy = zz = xy = xz = yz = zero
        for e in range(start[i], start[i + 1]):
            block, w = blocks[edge[e]], np.float32(0.5 * (weight[i] + weight[neighbour[e]]))
            x0, y0, z0 = block[0] - w, block[1], block[2]
            x1, y1, z1 = block[4], block[5] - w, block[6]
            x2, y2, z2 = block[8], block[9], block[10] - w
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
        D[i, 0, 0] = own[i, 0, 0] - xx
        D[i, 1, 1] = own[i, 1, 1] - yy
        D[i, 2, 2] = own[i, 2, 2] - zz
        xy, xz, yz = own[i, 0, 1] - xy, own[i, 0, 2] - xz, own[i, 1, 2] - yz
        D[i, 0, 1] = D[i, 1, 0] = xy
        D[i, 0, 2] = D[i, 2, 0] = xz
        D[i, 1, 2] = D[i, 2, 1] = yz


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
def stand_out(position, start, neighbour, boundary, share, out):
    """``share`` of what each vertex stands out of the mean of its neighbours; 0 at boundaries.

    Args:
        position: (V, 3) metres.
        start, neighbour: one-rings in compressed rows.
        boundary: (H,) vertices of boundaries.
        share: factor.
        out: (V, 3) metres.
    """
    for i in range(position.shape[0]):
        x = y = z = 0.0
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            x += position[j, 0] - position[i, 0]
            y += position[j, 1] - position[i, 1]
            z += position[j, 2] - position[i, 2]
        scale = -share / max(start[i + 1] - start[i], 1)
        out[i, 0], out[i, 1], out[i, 2] = scale * x, scale * y, scale * z
    for k in range(boundary.shape[0]):
        out[boundary[k], :] = 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def shift_along(target, normal, offset, shifted):
    """``shifted`` (V, 3) = ``target`` moved along its unit ``normal`` by what ``offset`` has along it, metres; (V, 3) each."""
    for i in range(target.shape[0]):
        along = normal[i, 0] * offset[i, 0] + normal[i, 1] * offset[i, 1] + normal[i, 2] * offset[i, 2]
        for a in range(3):
            shifted[i, a] = target[i, a] + along * normal[i, a]


@njit(nogil=True, cache=True, error_model="numpy")
def add_upward(upward, share, seen, up, force):
    """Adds upward forces on the vertices that are seen; each bears its share of their sum, so that together they are none.

    Args:
        upward: (V,) 1/m.
        share: (V,) of the cloth.
        seen: (V,) bool.
        up: (3,) unit vector.
        force: (V, 4) in and out, padded, 1/m.
    """
    total = cloth = 0.0
    for i in range(upward.shape[0]):
        if seen[i]:
            total += upward[i]
            cloth += share[i]
    for i in range(upward.shape[0]):
        if seen[i]:
            size = upward[i] - total / cloth * share[i]
            for a in range(3):
                force[i, a] += size * up[a]


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


@njit(nogil=True, cache=True, error_model="numpy")
def condition(prior, shift, velocity, posterior):
    """Velocity and blocks of each 6-vector after its position is known, see ``ddakf.stages.fuse.condition``.

    A gain larger than ``MOST_GAIN`` is scaled down. Over a step of a millisecond it would take noise for speed.

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
        squared = 0.0
        for r in range(3):
            for s in range(3):
                squared += G[r, s] * G[r, s]
                change[r, s] = posterior_pp[i, r, s] - P_pp[i, r, s]
        if squared > 3.0 * MOST_GAIN * MOST_GAIN:
            scale = MOST_GAIN * sqrt(3.0 / squared)
            for r in range(3):
                for s in range(3):
                    G[r, s] *= scale
        for r in range(3):
            velocity[i, r] += G[r, 0] * shift[i, 0] + G[r, 1] * shift[i, 1] + G[r, 2] * shift[i, 2]
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

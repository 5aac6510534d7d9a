"""Stage F, local rigidity: best-fitting rotations of one-rings, and the force of edges that do not follow them.

Rows are padded to four numbers and matrices are stored by columns, so that the compiler makes a vector of each.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.symmetric import invert3

LANES = 32  # vertices whose rotations are fitted side by side
STRAIGHT = 1e-6  # of the cube of a covariance's norm: the ring leaves its turn about itself open
NEWTON = 40  # steps to a root, at most


class LocalRigidity(NamedTuple):
    """One term of the MAP problem; ``weight``, ``rotation`` and ``shared`` are its only changing parts."""

    source: np.ndarray  # (2E, 3) float32 m, edge vectors s_ij = s_j - s_i of each entry of the one-rings
    weight: np.ndarray  # (V,) 1/m^2, of each one-ring; an edge has the mean of its ends'
    rotation: np.ndarray  # (V, 3, 3), R_i
    shared: np.ndarray  # (V, 12) float32 1/m^2, weight / 2 times T_i by columns padded to four, as the neighbours read it
    follow: np.ndarray  # (V, 8) float32 of followers(), how T_i stretches with its ring; (0, 8): T_i is R_i


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def fit_rotations(position, start, neighbour, term, iterations):
    """Fits the rotation of each one-ring from its source edges to the present ones.

    Maximises sum_j (x_j - x_i) . R_i s_ij by the iteration of Mueller, Bender, Chentanez and Macklin, "A robust method to
    extract the rotational part of deformations" (2016), which stays defined on flat rings. It starts from the rotations of the
    term. In float32: 1e-7 rad.

    Args:
        position: (V, 4) metres, padded.
        start, neighbour: one-rings in compressed rows.
        term: :class:`LocalRigidity`; its rotations are updated, and ``shared`` is written.
        iterations: fixed number of steps.
    """
    source, weight, rotation, shared, follow = term.source, term.weight, term.rotation, term.shared, term.follow
    n = position.shape[0]
    covariance = np.empty((LANES, 12), np.float32)
    lanes = np.ones(18 * LANES, np.float32)
    for first in range(0, n, LANES):
        size = min(LANES, n - first)
        for k in range(size):
            add_covariance(position, start, neighbour, source, first + k, covariance[k])
        for k in range(size):
            for b in range(3):
                for a in range(3):
                    lanes[(3 * b + a) * LANES + k] = covariance[k, 4 * b + a]
                    lanes[(9 + 3 * b + a) * LANES + k] = rotation[first + k, a, b]
        for _ in range(iterations):
            turn(lanes)
        for k in range(size):
            i = first + k
            half_weight = np.float32(0.5 * weight[i])
            for b in range(3):
                for a in range(3):
                    rotation[i, a, b] = lanes[(9 + 3 * b + a) * LANES + k]
                    shared[i, 4 * b + a] = half_weight * lanes[(9 + 3 * b + a) * LANES + k]
                shared[i, 4 * b + 3] = 0.0
            if follow.shape[0] > 0:
                stretch_rotation(covariance[k], follow[i], half_weight, shared[i])


@njit(nogil=True, cache=True, error_model="numpy")
def products(left, right, product):
    """A_i B_i of (V, 3, 3) matrices."""
    for i in range(left.shape[0]):
        for a in range(3):
            for b in range(3):
                x, y, z = right[i, 0, b], right[i, 1, b], right[i, 2, b]
                product[i, a, b] = left[i, a, 0] * x + left[i, a, 1] * y + left[i, a, 2] * z


@njit(nogil=True, cache=True, error_model="numpy")
def products_with_transposed(left, right, product):
    """A_i B_i' of (V, 3, 3) matrices."""
    for i in range(left.shape[0]):
        for a in range(3):
            for b in range(3):
                x, y, z = right[i, b, 0], right[i, b, 1], right[i, b, 2]
                product[i, a, b] = left[i, a, 0] * x + left[i, a, 1] * y + left[i, a, 2] * z


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def stretch_rotation(covariance, follow, half_weight, shared):
    """Replaces w / 2 R in ``shared`` (12,) by w / 2 (C + m R) (S + m I)^-1, by columns, padded.

    C is the ring's ``covariance`` (12,), and ``follow`` (8,) holds the rest, see :func:`followers`.
    """
    xx, yy, zz, xy, xz, yz, m = follow[0], follow[1], follow[2], follow[3], follow[4], follow[5], follow[6]
    for a in range(3):
        x = half_weight * covariance[a] + m * shared[a]
        y = half_weight * covariance[4 + a] + m * shared[4 + a]
        z = half_weight * covariance[8 + a] + m * shared[8 + a]
        shared[a] = x * xx + y * xy + z * xz
        shared[4 + a] = x * xy + y * yy + z * yz
        shared[8 + a] = x * xz + y * yz + z * zz


@njit(nogil=True, cache=True, error_model="numpy")
def followers(start, source, share, follow):
    """Constants with which a ring follows ``share`` in (0, 1) of its own strain in its plane.

    T = (C + m R) (S + m I)^-1 minimises sum_j |x_j - x_i - T s_ij|^2 + m |T - R|^2, with S = sum_j s_ij s_ij' and C the same
    with the present edges. S of a flat even ring is tr S / 2 in its plane. For m = (1 / share - 1) tr S / 2, T lies there the
    share of the way from R to the affine fit. Across the plane, where S is zero, T is R.

    Args:
        start: one-rings in compressed rows.
        source: (2E, 3) float32 s_ij, metres.
        share: of the ring's strain that T follows.
        follow: (V, 8) float32 out: (S + m I)^-1 as xx, yy, zz, xy, xz, yz in 1/m^2, m in m^2, and a zero.
    """
    for i in range(start.shape[0] - 1):
        a = b = c = d = e = f = 0.0
        for k in range(start[i], start[i + 1]):
            x, y, z = np.float64(source[k, 0]), np.float64(source[k, 1]), np.float64(source[k, 2])
            a += x * x
            b += y * y
            c += z * z
            d += x * y
            e += x * z
            f += y * z
        m = (1.0 / share - 1.0) * 0.5 * (a + b + c)
        a, b, c, d, e, f = invert3(a + m, b + m, c + m, d, e, f)
        follow[i, 0], follow[i, 1], follow[i, 2], follow[i, 3] = a, b, c, d
        follow[i, 4], follow[i, 5], follow[i, 6], follow[i, 7] = e, f, m, 0.0


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def add_covariance(position, start, neighbour, source, i, out):
    """out (12,): sum_j (x_j - x_i) s_ij' of the ring of vertex i, by columns, padded."""
    px, py, pz, pw = position[i, 0], position[i, 1], position[i, 2], position[i, 3]
    ax = ay = az = aw = bx = by = bz = bw = cx = cy = cz = cw = np.float32(0.0)
    for e in range(start[i], start[i + 1]):
        j = neighbour[e]
        ex, ey = np.float32(position[j, 0] - px), np.float32(position[j, 1] - py)
        ez, ew = np.float32(position[j, 2] - pz), np.float32(position[j, 3] - pw)
        s = source[e, 0]
        ax += ex * s
        ay += ey * s
        az += ez * s
        aw += ew * s
        s = source[e, 1]
        bx += ex * s
        by += ey * s
        bz += ez * s
        bw += ew * s
        s = source[e, 2]
        cx += ex * s
        cy += ey * s
        cz += ez * s
        cw += ew * s
    out[0], out[1], out[2], out[3] = ax, ay, az, aw
    out[4], out[5], out[6], out[7] = bx, by, bz, bw
    out[8], out[9], out[10], out[11] = cx, cy, cz, cw


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def turn(lanes):
    """One step of the iteration on LANES rings.

    ``lanes`` (18 * LANES,) in and out: covariance and rotation, each by columns. It is flat, so that the distance of its rows is
    a constant: the compiler then knows that they do not overlap, and computes eight rings or more at once.
    """
    one, two, half, tiny = np.float32(1.0), np.float32(2.0), np.float32(0.5), np.float32(1e-20)
    for k in range(LANES):
        c00, c10, c20 = lanes[k], lanes[LANES + k], lanes[2 * LANES + k]
        c01, c11, c21 = lanes[3 * LANES + k], lanes[4 * LANES + k], lanes[5 * LANES + k]
        c02, c12, c22 = lanes[6 * LANES + k], lanes[7 * LANES + k], lanes[8 * LANES + k]
        r00, r10, r20 = lanes[9 * LANES + k], lanes[10 * LANES + k], lanes[11 * LANES + k]
        r01, r11, r21 = lanes[12 * LANES + k], lanes[13 * LANES + k], lanes[14 * LANES + k]
        r02, r12, r22 = lanes[15 * LANES + k], lanes[16 * LANES + k], lanes[17 * LANES + k]
        # omega = sum of columns r_k x c_k over |sum of r_k . c_k|
        wx = r10 * c20 - r20 * c10 + r11 * c21 - r21 * c11 + r12 * c22 - r22 * c12
        wy = r20 * c00 - r00 * c20 + r21 * c01 - r01 * c21 + r22 * c02 - r02 * c22
        wz = r00 * c10 - r10 * c00 + r01 * c11 - r11 * c01 + r02 * c12 - r12 * c02
        trace = r00 * c00 + r10 * c10 + r20 * c20 + r01 * c01 + r11 * c11 + r21 * c21 + r02 * c02 + r12 * c12 + r22 * c22
        # Cayley's rotation of about that angle: (1 + h^2) Q = (1 - h^2) I + 2 h h' + 2 [h]x, h = omega / 2
        scale = half / (abs(trace) + tiny)
        hx, hy, hz = wx * scale, wy * scale, wz * scale
        h2 = hx * hx + hy * hy + hz * hz
        t = one / (one + h2)
        d = (one - h2) * t
        hx2, hy2, hz2 = two * t * hx, two * t * hy, two * t * hz
        q00, q01, q02 = d + hx2 * hx, hx2 * hy - hz2, hx2 * hz + hy2
        q10, q11, q12 = hx2 * hy + hz2, d + hy2 * hy, hy2 * hz - hx2
        q20, q21, q22 = hx2 * hz - hy2, hy2 * hz + hx2, d + hz2 * hz
        ax = q00 * r00 + q01 * r10 + q02 * r20
        ay = q10 * r00 + q11 * r10 + q12 * r20
        az = q20 * r00 + q21 * r10 + q22 * r20
        bx = q00 * r01 + q01 * r11 + q02 * r21
        by = q10 * r01 + q11 * r11 + q12 * r21
        bz = q20 * r01 + q21 * r11 + q22 * r21
        # orthonormal again: rounding errors would add up over thousands of frames
        s = one / sqrt(ax * ax + ay * ay + az * az)
        ax, ay, az = ax * s, ay * s, az * s
        d = ax * bx + ay * by + az * bz
        bx, by, bz = bx - d * ax, by - d * ay, bz - d * az
        s = one / sqrt(bx * bx + by * by + bz * bz)
        bx, by, bz = bx * s, by * s, bz * s
        lanes[9 * LANES + k], lanes[10 * LANES + k], lanes[11 * LANES + k] = ax, ay, az
        lanes[12 * LANES + k], lanes[13 * LANES + k], lanes[14 * LANES + k] = bx, by, bz
        lanes[15 * LANES + k], lanes[16 * LANES + k] = ay * bz - az * by, az * bx - ax * bz
        lanes[17 * LANES + k] = ax * by - ay * bx


@njit(nogil=True, cache=True, error_model="numpy")
def best_rotations(position, start, neighbour, source, covariance, rotation, straight):
    """The rotation of each one-ring that maximises sum_j (x_j - x_i) . R s_ij, without a start.

    Markley 1993, "Attitude determination using vector observations: a fast optimal matrix algorithm": the maximum is the largest
    root of a quartic, which Newton's steps reach from above, and the rotation is rational in it.

    Args:
        position: (V, 3) metres.
        start, neighbour: one-rings in compressed rows.
        source: (2E, 3) s_ij, metres.
        covariance: (V, 3, 3) out, sum_j (x_j - x_i) s_ij', m^2.
        rotation: (V, 3, 3) out, left as it is where the ring is straight.
        straight: (V,) bool out, rings that leave their turn about themselves open.
    """
    B, C = np.empty((3, 3)), np.empty((3, 3))
    for i in range(position.shape[0]):
        B[:] = 0.0
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            for a in range(3):
                x = position[j, a] - position[i, a]
                for b in range(3):
                    B[a, b] += x * source[e, b]
        size2 = 0.0
        for a in range(3):
            for b in range(3):
                size2 += B[a, b] * B[a, b]
        scale = 1.0 / sqrt(size2) if size2 > 0.0 else 0.0
        covariance[i] = B
        B *= scale
        cofactors2 = 0.0
        for a in range(3):
            p, q = (a + 1) % 3, (a + 2) % 3
            for b in range(3):
                r, s = (b + 1) % 3, (b + 2) % 3
                C[a, b] = B[p, r] * B[q, s] - B[p, s] * B[q, r]
                cofactors2 += C[a, b] * C[a, b]
        det = B[0, 0] * C[0, 0] + B[0, 1] * C[0, 1] + B[0, 2] * C[0, 2]
        root = sqrt(3.0)
        for _ in range(NEWTON):
            square = root * root - 1.0
            slope = 4.0 * root * square - 8.0 * det
            step = (square * square - 8.0 * root * det - 4.0 * cofactors2) / slope if slope > 0.0 else 0.0
            root -= step
            if step < 1e-15:
                break
        share = 0.5 * (root * root - 1.0)
        divisor = share * root - det
        straight[i] = not divisor > STRAIGHT
        if straight[i]:
            continue
        for a in range(3):
            for b in range(3):
                cubic = 0.0
                for c in range(3):
                    cubic += (B[a, 0] * B[c, 0] + B[a, 1] * B[c, 1] + B[a, 2] * B[c, 2]) * B[c, b]
                rotation[i, a, b] = ((share + 1.0) * B[a, b] + root * C[a, b] - cubic) / divisor


@njit(nogil=True, cache=True, error_model="numpy")
def edge_vectors(position, start, neighbour, edge):
    """edge (2E, 3) out: x_j - x_i of each entry of the one-rings, metres."""
    for i in range(position.shape[0]):
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            for a in range(3):
                edge[e, a] = position[j, a] - position[i, a]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def add_force(position, start, neighbour, term, force):
    """Adds -gradient of 1/4 sum_i w_i sum_j |x_j - x_i - R_i s_ij|^2, the rotations held.

    Args:
        position: (V, 4) metres, padded.
        start, neighbour: one-rings in compressed rows.
        term: :class:`LocalRigidity`, after :func:`fit_rotations`.
        force: (V, 4) padded, 1/m, added to.
    """
    source, weight, shared = term.source, term.weight, term.shared
    for i in range(position.shape[0]):
        px, py, pz, pw = position[i, 0], position[i, 1], position[i, 2], position[i, 3]
        half_weight = 0.5 * weight[i]
        fx = fy = fz = fw = 0.0
        gx = gy = gz = gw = sx = sy = sz = np.float32(0.0)
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            w = half_weight + 0.5 * weight[j]
            fx += w * (position[j, 0] - px)
            fy += w * (position[j, 1] - py)
            fz += w * (position[j, 2] - pz)
            fw += w * (position[j, 3] - pw)
            x, y, z = source[e, 0], source[e, 1], source[e, 2]
            sx += x
            sy += y
            sz += z
            gx += shared[j, 0] * x + shared[j, 4] * y + shared[j, 8] * z
            gy += shared[j, 1] * x + shared[j, 5] * y + shared[j, 9] * z
            gz += shared[j, 2] * x + shared[j, 6] * y + shared[j, 10] * z
            gw += shared[j, 3] * x + shared[j, 7] * y + shared[j, 11] * z
        gx += shared[i, 0] * sx + shared[i, 4] * sy + shared[i, 8] * sz
        gy += shared[i, 1] * sx + shared[i, 5] * sy + shared[i, 9] * sz
        gz += shared[i, 2] * sx + shared[i, 6] * sy + shared[i, 10] * sz
        gw += shared[i, 3] * sx + shared[i, 7] * sy + shared[i, 11] * sz
        force[i, 0] += fx - gx
        force[i, 1] += fy - gy
        force[i, 2] += fz - gz
        force[i, 3] += fw - gw

"""Stage E, bending (paper, section 2.4): signed dihedral angle of a hinge and its gradient.

Edge e = x1 - x0, n1 = e x (x2 - x0), n2 = (x3 - x0) x e, m_f = n_f / |n_f|^2:
theta = atan2((n1 x n2) . e / |e|, n1 . n2), and
dtheta/dx2 = -|e| m1, dtheta/dx3 = -|e| m2,
dtheta/dx1 = ((x2 - x0) . e m1 + (x3 - x0) . e m2) / |e|, dtheta/dx0 = -(the sum of the others).
"""

from math import atan2, floor, pi, sqrt

import numpy as np
from numba import njit

from ddakf.kernels import FAST

LANES = 32  # hinges that are computed side by side


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def hinge(positions, stencil, c, rest_angle, least):
    """Residual of hinge c in rad, and its derivatives by x1, x2 and x3 in rad/m; by x0 it is minus their sum.

    Args:
        positions: (V, 3) metres.
        stencil: (C, 4) vertices x0 to x3 of each hinge.
        c: the hinge.
        rest_angle: (C,) rad.
        least: (C, 2) least squared length of the normals n1 and n2, m^4.
    """
    i0, i1, i2, i3 = stencil[c, 0], stencil[c, 1], stencil[c, 2], stencil[c, 3]
    x, y, z = positions[i0, 0], positions[i0, 1], positions[i0, 2]
    ex, ey, ez = positions[i1, 0] - x, positions[i1, 1] - y, positions[i1, 2] - z
    ax, ay, az = positions[i2, 0] - x, positions[i2, 1] - y, positions[i2, 2] - z
    bx, by, bz = positions[i3, 0] - x, positions[i3, 1] - y, positions[i3, 2] - z
    n1x, n1y, n1z = ey * az - ez * ay, ez * ax - ex * az, ex * ay - ey * ax
    n2x, n2y, n2z = by * ez - bz * ey, bz * ex - bx * ez, bx * ey - by * ex
    length = sqrt(ex * ex + ey * ey + ez * ez)
    inverse = 1.0 / length if length > 1e-12 else 0.0
    # (n1 x n2) . e / |e| = -|e| n1 . (x3 - x0), without the cross product of the normals
    sine = -length * (n1x * bx + n1y * by + n1z * bz)
    cosine = n1x * n2x + n1y * n2y + n1z * n2z
    difference = atan2(sine, cosine) - rest_angle[c]
    residual = difference - 2.0 * pi * floor((difference + pi) / (2.0 * pi))
    m1 = 1.0 / max(n1x * n1x + n1y * n1y + n1z * n1z, least[c, 0])
    m2 = 1.0 / max(n2x * n2x + n2y * n2y + n2z * n2z, least[c, 1])
    along1 = (ax * ex + ay * ey + az * ez) * inverse * m1
    along2 = (bx * ex + by * ey + bz * ez) * inverse * m2
    m1, m2 = -length * m1, -length * m2
    g1 = along1 * n1x + along2 * n2x, along1 * n1y + along2 * n2y, along1 * n1z + along2 * n2z
    return residual, g1, (m1 * n1x, m1 * n1y, m1 * n1z), (m2 * n2x, m2 * n2y, m2 * n2z)


@njit(nogil=True, cache=True, error_model="numpy")
def linearize(positions, stencil, rest_angle, least, residual, jacobian):
    """Residual (C,) rad and Jacobian (C, 4, 3) rad/m of every hinge, out; the other arguments as for :func:`hinge`."""
    for c in range(stencil.shape[0]):
        residual[c], g1, g2, g3 = hinge(positions, stencil, c, rest_angle, least)
        for a in range(3):
            jacobian[c, 0, a] = -(g1[a] + g2[a] + g3[a])
            jacobian[c, 1, a] = g1[a]
            jacobian[c, 2, a] = g2[a]
            jacobian[c, 3, a] = g3[a]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def add_hinges(positions, stencil, rest_angle, least, weight, stiffness, blocks, force):
    """Adds bending: its exact force, and as its matrix the block-diagonal majoriser.

    A hinge's k J^T J couples vertices that are not neighbours. 4 k blockdiag(J_s^T J_s) is nowhere smaller (Cauchy-Schwarz on
    its four terms), so the step stays a descent step and A keeps the sparsity of the one-rings.

    LANES hinges are computed side by side, in float32 from differences in float64. The angle at a face of height h beside an
    edge of 5 cm is exact to 1e-5 rad for h = 0.01 mm, and means little below 1e-6 mm.

    Args:
        positions: (V, 3) metres.
        stencil, rest_angle, least, weight: the constants of ``ddakf.physics.bend``.
        stiffness: 1/rad^2.
        blocks: (V, 3, 3) symmetric, added to.
        force: (V, 4) padded, minus the gradient is added.
    """
    n = stencil.shape[0]
    rows = np.zeros((blocks.shape[0], 8))  # xx, yy, zz, 0 and xy, xz, yz, 0: two vectors
    lanes = np.ones(21 * LANES, np.float32)
    for first in range(0, n, LANES):
        size = min(LANES, n - first)
        for k in range(size):
            c = first + k
            i0, i1 = np.uint32(stencil[c, 0]), np.uint32(stencil[c, 1])  # unsigned: no test for indices from the end
            i2, i3 = np.uint32(stencil[c, 2]), np.uint32(stencil[c, 3])
            for a in range(3):
                origin = positions[i0, a]
                lanes[a * LANES + k] = positions[i1, a] - origin
                lanes[(3 + a) * LANES + k] = positions[i2, a] - origin
                lanes[(6 + a) * LANES + k] = positions[i3, a] - origin
            lanes[9 * LANES + k], lanes[10 * LANES + k], lanes[11 * LANES + k] = rest_angle[c], least[c, 0], least[c, 1]
        bend_lanes(lanes)
        for k in range(size):
            c = first + k
            scale = stiffness * weight[c]
            f, m = scale * lanes[20 * LANES + k], 4.0 * scale
            x1, y1, z1 = np.float64(lanes[11 * LANES + k]), np.float64(lanes[12 * LANES + k]), np.float64(lanes[13 * LANES + k])
            x2, y2, z2 = np.float64(lanes[14 * LANES + k]), np.float64(lanes[15 * LANES + k]), np.float64(lanes[16 * LANES + k])
            x3, y3, z3 = np.float64(lanes[17 * LANES + k]), np.float64(lanes[18 * LANES + k]), np.float64(lanes[19 * LANES + k])
            add_corner(np.uint32(stencil[c, 0]), (-(x1 + x2 + x3), -(y1 + y2 + y3), -(z1 + z2 + z3)), f, m, rows, force)
            add_corner(np.uint32(stencil[c, 1]), (x1, y1, z1), f, m, rows, force)
            add_corner(np.uint32(stencil[c, 2]), (x2, y2, z2), f, m, rows, force)
            add_corner(np.uint32(stencil[c, 3]), (x3, y3, z3), f, m, rows, force)
    for i in range(blocks.shape[0]):
        xy, xz, yz = rows[i, 4], rows[i, 5], rows[i, 6]
        blocks[i, 0, 0] += rows[i, 0]
        blocks[i, 1, 1] += rows[i, 1]
        blocks[i, 2, 2] += rows[i, 2]
        blocks[i, 0, 1] += xy
        blocks[i, 1, 0] += xy
        blocks[i, 0, 2] += xz
        blocks[i, 2, 0] += xz
        blocks[i, 1, 2] += yz
        blocks[i, 2, 1] += yz


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def bend_lanes(lanes):
    """:func:`hinge` on LANES hinges side by side, in float32 and without branches.

    ``lanes`` is flat, so that the distance of its rows is a constant: the compiler then knows that they do not overlap, and
    computes eight hinges or more at once.

    Args:
        lanes: (21 * LANES,); in: x1 - x0, x2 - x0, x3 - x0, the rest angle, and both entries of ``least``; out, from row 11: the
            derivatives by x1, x2 and x3, and the residual.
    """
    zero, one, short, tiny = np.float32(0.0), np.float32(1.0), np.float32(1e-12), np.float32(1e-30)
    half_pi, straight, full = np.float32(0.5 * pi), np.float32(pi), np.float32(2.0 * pi)
    for k in range(LANES):
        ex, ey, ez = lanes[k], lanes[LANES + k], lanes[2 * LANES + k]
        ax, ay, az = lanes[3 * LANES + k], lanes[4 * LANES + k], lanes[5 * LANES + k]
        bx, by, bz = lanes[6 * LANES + k], lanes[7 * LANES + k], lanes[8 * LANES + k]
        n1x, n1y, n1z = ey * az - ez * ay, ez * ax - ex * az, ex * ay - ey * ax
        n2x, n2y, n2z = by * ez - bz * ey, bz * ex - bx * ez, bx * ey - by * ex
        length = sqrt(ex * ex + ey * ey + ez * ez)
        inverse = one / max(length, short) if length > short else zero
        sine = -length * (n1x * bx + n1y * by + n1z * bz)
        cosine = n1x * n2x + n1y * n2y + n1z * n2z
        # atan2 as in Cephes: the polynomial of atan below tan(pi / 8), reached by t -> (t - 1) / (t + 1) and t -> 1 / t
        s, c = abs(sine), abs(cosine)
        low, high = min(s, c), max(s, c)
        beyond = low > np.float32(0.41421356) * high
        t = (low - high if beyond else low) / max(low + high if beyond else high, tiny)
        z = t * t
        p = ((np.float32(8.05374449538e-2) * z - np.float32(1.38776856032e-1)) * z + np.float32(1.99777106478e-1)) * z
        angle = t + t * z * (p - np.float32(3.33329491539e-1)) + (np.float32(0.25 * pi) if beyond else zero)
        angle = half_pi - angle if s > c else angle
        angle = straight - angle if cosine < zero else angle
        difference = (-angle if sine < zero else angle) - lanes[9 * LANES + k]
        difference = difference - full if difference >= straight else difference
        difference = difference + full if difference < -straight else difference
        m1 = one / max(n1x * n1x + n1y * n1y + n1z * n1z, lanes[10 * LANES + k])
        m2 = one / max(n2x * n2x + n2y * n2y + n2z * n2z, lanes[11 * LANES + k])
        along1 = (ax * ex + ay * ey + az * ez) * inverse * m1
        along2 = (bx * ex + by * ey + bz * ez) * inverse * m2
        m1, m2 = -length * m1, -length * m2
        lanes[11 * LANES + k], lanes[12 * LANES + k] = along1 * n1x + along2 * n2x, along1 * n1y + along2 * n2y
        lanes[13 * LANES + k] = along1 * n1z + along2 * n2z
        lanes[14 * LANES + k], lanes[15 * LANES + k], lanes[16 * LANES + k] = m1 * n1x, m1 * n1y, m1 * n1z
        lanes[17 * LANES + k], lanes[18 * LANES + k], lanes[19 * LANES + k] = m2 * n2x, m2 * n2y, m2 * n2z
        lanes[20 * LANES + k] = difference


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def add_corner(i, gradient, f, m, rows, force):
    """Adds one vertex of a hinge: -f g to its force, and m g g' on and above the diagonal to its block in ``rows``."""
    x, y, z = gradient
    row = force[i]
    a, b, c, d = row[0] - f * x, row[1] - f * y, row[2] - f * z, row[3]
    row[0], row[1], row[2], row[3] = a, b, c, d
    row = rows[i]
    a, b, c, d = row[0] + m * x * x, row[1] + m * y * y, row[2] + m * z * z, row[3]
    row[0], row[1], row[2], row[3] = a, b, c, d
    a, b, c, d = row[4] + m * x * y, row[5] + m * x * z, row[6] + m * y * z, row[7]
    row[4], row[5], row[6], row[7] = a, b, c, d

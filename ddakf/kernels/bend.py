"""Stage E, bending (paper, section 2.4): signed dihedral angle of a hinge and its gradient.

Edge e = x1 - x0, n1 = e x (x2 - x0), n2 = (x3 - x0) x e, m_f = n_f / |n_f|^2:
theta = atan2((n1 x n2) . e / |e|, n1 . n2), and
dtheta/dx2 = -|e| m1, dtheta/dx3 = -|e| m2,
dtheta/dx1 = ((x2 - x0) . e m1 + (x3 - x0) . e m2) / |e|, dtheta/dx0 = -(the sum of the others).
"""

from math import atan2, floor, pi, sqrt

from numba import njit

from ddakf.kernels import FAST


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

    Args:
        positions: (V, 3) metres.
        stencil, rest_angle, least, weight: the constants of ``ddakf.physics.bend``.
        stiffness: 1/rad^2.
        blocks: (V, 3, 3) symmetric, added to.
        force: (V, 3) or wider, minus the gradient is added.
    """
    for c in range(stencil.shape[0]):
        residual, g1, g2, g3 = hinge(positions, stencil, c, rest_angle, least)
        k = stiffness * weight[c]
        g0 = -(g1[0] + g2[0] + g3[0]), -(g1[1] + g2[1] + g3[1]), -(g1[2] + g2[2] + g3[2])
        add_corner(stencil[c, 0], g0, k, residual, blocks, force)
        add_corner(stencil[c, 1], g1, k, residual, blocks, force)
        add_corner(stencil[c, 2], g2, k, residual, blocks, force)
        add_corner(stencil[c, 3], g3, k, residual, blocks, force)
    for i in range(blocks.shape[0]):
        blocks[i, 1, 0], blocks[i, 2, 0], blocks[i, 2, 1] = blocks[i, 0, 1], blocks[i, 0, 2], blocks[i, 1, 2]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def add_corner(i, gradient, k, residual, blocks, force):
    """Adds one vertex of a hinge: -k r g to its force, and 4 k g g' on and above the diagonal to its block."""
    x, y, z = gradient
    f, m = k * residual, 4.0 * k
    force[i, 0] -= f * x
    force[i, 1] -= f * y
    force[i, 2] -= f * z
    blocks[i, 0, 0] += m * x * x
    blocks[i, 1, 1] += m * y * y
    blocks[i, 2, 2] += m * z * z
    blocks[i, 0, 1] += m * x * y
    blocks[i, 0, 2] += m * x * z
    blocks[i, 1, 2] += m * y * z

"""Stage E, strain (paper, section 2.4): stretch and shear of a triangle at once, force and blocks without Jacobians."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST


class StrainConstants(NamedTuple):
    """F faces, each with its corners in ascending order."""

    corner: np.ndarray  # (F, 3) uint32
    edge: np.ndarray  # (F, 3) uint32, the mesh's edge of corners 0 and 1, 0 and 2, 1 and 2
    warp: np.ndarray  # (F, 3) 1/m: w_u = sum_a warp[a] p_a
    weft: np.ndarray  # (F, 3) 1/m
    area: np.ndarray  # (F,) m^2


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def add_strain(position, constants, stretch, shear, softness, blocks, force):
    """Adds softened stretch, and shear.

    With the tangents w = w_u and t = w_v and energy k_w (|w| - 1)^2 / 2 + k_t (|t| - 1)^2 / 2 + h (w . t)^2 / 2, the
    Gauss-Newton block of two corners with coefficients (a, b) and (c, d) is
    a c (k_w w w' / |w|^2 + h t t') + b d (k_t t t' / |t|^2 + h w w') + h (a d t w' + b c w t').

    Args:
        position: (V, 3) metres.
        constants: :class:`StrainConstants`.
        stretch, shear: stiffness, 1/m^2.
        softness: square of the strain at which a constraint counts half, as in ``ddakf.physics.energies.softened``.
        blocks: (E, 9) float32, added to: dE^2/dp_i dp_j of each edge i < j, by columns.
        force: (V, 3) or wider, minus the gradient is added.
    """
    corner, edge, warp, weft, area = constants
    for f in range(corner.shape[0]):
        i, j, k = corner[f, 0], corner[f, 1], corner[f, 2]
        u0, u1, u2 = warp[f, 0], warp[f, 1], warp[f, 2]
        v0, v1, v2 = weft[f, 0], weft[f, 1], weft[f, 2]
        px, py, pz = position[i, 0], position[i, 1], position[i, 2]
        ax, ay, az = position[j, 0] - px, position[j, 1] - py, position[j, 2] - pz
        bx, by, bz = position[k, 0] - px, position[k, 1] - py, position[k, 2] - pz
        wx, wy, wz = u1 * ax + u2 * bx, u1 * ay + u2 * by, u1 * az + u2 * bz
        tx, ty, tz = v1 * ax + v2 * bx, v1 * ay + v2 * by, v1 * az + v2 * bz
        length_w, length_t = sqrt(wx * wx + wy * wy + wz * wz), sqrt(tx * tx + ty * ty + tz * tz)
        strain_w, strain_t = length_w - 1.0, length_t - 1.0
        k_w = stretch * area[f] * softness / (softness + strain_w * strain_w)
        k_t = stretch * area[f] * softness / (softness + strain_t * strain_t)
        h = 0.5 * shear * area[f]
        # a tangent of no length has no direction: full residual, no force, until something else moves it
        inverse_w = 1.0 / length_w if length_w > 1e-12 else 0.0
        inverse_t = 1.0 / length_t if length_t > 1e-12 else 0.0
        f_w, f_t, f_h = k_w * strain_w * inverse_w, k_t * strain_t * inverse_t, h * (wx * tx + wy * ty + wz * tz)
        gx, gy, gz = f_w * wx + f_h * tx, f_w * wy + f_h * ty, f_w * wz + f_h * tz  # dE/dw
        hx, hy, hz = f_t * tx + f_h * wx, f_t * ty + f_h * wy, f_t * tz + f_h * wz  # dE/dt
        jx, jy, jz = u1 * gx + v1 * hx, u1 * gy + v1 * hy, u1 * gz + v1 * hz
        kx, ky, kz = u2 * gx + v2 * hx, u2 * gy + v2 * hy, u2 * gz + v2 * hz
        force[i, 0] += jx + kx
        force[i, 1] += jy + ky
        force[i, 2] += jz + kz
        force[j, 0] -= jx
        force[j, 1] -= jy
        force[j, 2] -= jz
        force[k, 0] -= kx
        force[k, 1] -= ky
        force[k, 2] -= kz
        k_w *= inverse_w * inverse_w
        k_t *= inverse_t * inverse_t
        for pair in range(3):
            if pair == 0:
                a, b, c, d = u0, v0, u1, v1
            elif pair == 1:
                a, b, c, d = u0, v0, u2, v2
            else:
                a, b, c, d = u1, v1, u2, v2
            # the block is y w' + z t'
            e = edge[f, pair]
            m_w, m_t = a * c * k_w + b * d * h, a * c * h + b * d * k_t
            r, s = h * a * d, h * b * c
            yx, yy, yz = m_w * wx + r * tx, m_w * wy + r * ty, m_w * wz + r * tz
            zx, zy, zz = m_t * tx + s * wx, m_t * ty + s * wy, m_t * tz + s * wz
            blocks[e, 0] += np.float32(yx * wx + zx * tx)
            blocks[e, 1] += np.float32(yy * wx + zy * tx)
            blocks[e, 2] += np.float32(yz * wx + zz * tx)
            blocks[e, 3] += np.float32(yx * wy + zx * ty)
            blocks[e, 4] += np.float32(yy * wy + zy * ty)
            blocks[e, 5] += np.float32(yz * wy + zz * ty)
            blocks[e, 6] += np.float32(yx * wz + zx * tz)
            blocks[e, 7] += np.float32(yy * wz + zy * tz)
            blocks[e, 8] += np.float32(yz * wz + zz * tz)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def squared_strains(position, measured, constants, squared):
    """(|w| - 1)^2 + (|t| - 1)^2 + (w . t)^2 / 2, the squared norm of the strain, of every face with three measured corners.

    Returns the number of those faces.

    Args:
        position: (V, 3) metres.
        measured: (V,) bool.
        constants: :class:`StrainConstants`.
        squared: (F,) out, one entry per face counted.
    """
    corner, warp, weft = constants.corner, constants.warp, constants.weft
    n = 0
    for f in range(corner.shape[0]):
        i, j, k = corner[f, 0], corner[f, 1], corner[f, 2]
        if not (measured[i] and measured[j] and measured[k]):
            continue
        ww = tt = wt = 0.0
        for a in range(3):
            x, y = position[j, a] - position[i, a], position[k, a] - position[i, a]
            w, t = warp[f, 1] * x + warp[f, 2] * y, weft[f, 1] * x + weft[f, 2] * y
            ww += w * w
            tt += t * t
            wt += w * t
        along, across = sqrt(ww) - 1.0, sqrt(tt) - 1.0
        squared[n] = along * along + across * across + 0.5 * wt * wt
        n += 1
    return n

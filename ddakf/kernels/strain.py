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

    In float32, of which each four are a vector.

    Args:
        position: (V, 4) metres, padded.
        constants: :class:`StrainConstants`.
        stretch, shear: stiffness, 1/m^2.
        softness: square of the strain at which a constraint counts half, as in ``ddakf.physics.energies.softened``.
        blocks: (E, 12) float32, added to: dE^2/dp_i dp_j of each edge i < j, by columns, padded.
        force: (V, 4) padded, minus the gradient is added.
    """
    corner, edge, warp, weft, area = constants
    one, zero, tiny, half = np.float32(1.0), np.float32(0.0), np.float32(1e-12), np.float32(0.5)
    stretch, shear, softness = np.float32(stretch), np.float32(shear), np.float32(softness)
    for f in range(corner.shape[0]):
        i, j, k = corner[f, 0], corner[f, 1], corner[f, 2]
        u0, u1, u2 = np.float32(warp[f, 0]), np.float32(warp[f, 1]), np.float32(warp[f, 2])
        v0, v1, v2 = np.float32(weft[f, 0]), np.float32(weft[f, 1]), np.float32(weft[f, 2])
        px, py, pz, pw = position[i, 0], position[i, 1], position[i, 2], position[i, 3]
        ax, ay = np.float32(position[j, 0] - px), np.float32(position[j, 1] - py)
        az, aw = np.float32(position[j, 2] - pz), np.float32(position[j, 3] - pw)
        bx, by = np.float32(position[k, 0] - px), np.float32(position[k, 1] - py)
        bz, bw = np.float32(position[k, 2] - pz), np.float32(position[k, 3] - pw)
        wx, wy, wz, ww = u1 * ax + u2 * bx, u1 * ay + u2 * by, u1 * az + u2 * bz, u1 * aw + u2 * bw
        tx, ty, tz, tw = v1 * ax + v2 * bx, v1 * ay + v2 * by, v1 * az + v2 * bz, v1 * aw + v2 * bw
        length_w, length_t = sqrt(wx * wx + wy * wy + wz * wz), sqrt(tx * tx + ty * ty + tz * tz)
        strain_w, strain_t = length_w - one, length_t - one
        share = np.float32(area[f])
        k_w = stretch * share * softness / (softness + strain_w * strain_w)
        k_t = stretch * share * softness / (softness + strain_t * strain_t)
        h = half * shear * share
        # a tangent of no length has no direction: full residual, no force, until something else moves it
        inverse_w = one / length_w if length_w > tiny else zero
        inverse_t = one / length_t if length_t > tiny else zero
        f_w, f_t, f_h = k_w * strain_w * inverse_w, k_t * strain_t * inverse_t, h * (wx * tx + wy * ty + wz * tz)
        # dE/dw = f_w w + f_h t, dE/dt = f_t t + f_h w
        c_w, c_t, d_w, d_t = u1 * f_w + v1 * f_h, u1 * f_h + v1 * f_t, u2 * f_w + v2 * f_h, u2 * f_h + v2 * f_t
        jx, jy, jz, jw = c_w * wx + c_t * tx, c_w * wy + c_t * ty, c_w * wz + c_t * tz, c_w * ww + c_t * tw
        kx, ky, kz, kw = d_w * wx + d_t * tx, d_w * wy + d_t * ty, d_w * wz + d_t * tz, d_w * ww + d_t * tw
        add_row(force, i, jx + kx, jy + ky, jz + kz, jw + kw)
        add_row(force, j, -jx, -jy, -jz, -jw)
        add_row(force, k, -kx, -ky, -kz, -kw)
        w, t = (wx, wy, wz, ww), (tx, ty, tz, tw)
        stiffness = k_w * inverse_w * inverse_w, k_t * inverse_t * inverse_t, h
        add_block(blocks[edge[f, 0]], (u0, v0, u1, v1), stiffness, w, t)
        add_block(blocks[edge[f, 1]], (u0, v0, u2, v2), stiffness, w, t)
        add_block(blocks[edge[f, 2]], (u1, v1, u2, v2), stiffness, w, t)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def add_row(rows, i, x, y, z, w):
    """rows[i] += (x, y, z, w)."""
    a, b, c, d = rows[i, 0] + x, rows[i, 1] + y, rows[i, 2] + z, rows[i, 3] + w
    rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3] = a, b, c, d


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def add_block(block, coefficients, stiffness, w, t):
    """Adds the block of two corners, see :func:`add_strain`, to ``block`` (12,): y w' + z t' by columns, padded.

    Args:
        block: (12,) float32.
        coefficients: a, b of one corner and c, d of the other.
        stiffness: k_w / |w|^2, k_t / |t|^2, h.
        w, t: tangents, padded.
    """
    a, b, c, d = coefficients
    k_w, k_t, h = stiffness
    m_w, m_t = a * c * k_w + b * d * h, a * c * h + b * d * k_t
    r, s = h * a * d, h * b * c
    y0, y1, y2, y3 = m_w * w[0] + r * t[0], m_w * w[1] + r * t[1], m_w * w[2] + r * t[2], m_w * w[3] + r * t[3]
    z0, z1, z2, z3 = m_t * t[0] + s * w[0], m_t * t[1] + s * w[1], m_t * t[2] + s * w[2], m_t * t[3] + s * w[3]
    for column in range(3):
        p, q, first = w[column], t[column], 4 * column
        e0, e1, e2, e3 = block[first], block[first + 1], block[first + 2], block[first + 3]
        e0, e1, e2, e3 = e0 + y0 * p + z0 * q, e1 + y1 * p + z1 * q, e2 + y2 * p + z2 * q, e3 + y3 * p + z3 * q
        block[first], block[first + 1], block[first + 2], block[first + 3] = e0, e1, e2, e3


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

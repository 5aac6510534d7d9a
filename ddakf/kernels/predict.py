"""Stage A, prediction (paper, section 2.2): the covariance of position and velocity after a time step."""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels.symmetric import invert3

SMALL_ANGLE = 1e-3  # rad, below which a series replaces sin(a / 2) / a


class CovarianceBlocks(NamedTuple):
    """Covariance of (p, u) of each vertex, in blocks."""

    pp: np.ndarray  # (V, 3, 3) m^2
    pu: np.ndarray  # (V, 3, 3) m^2/s
    uu: np.ndarray  # (V, 3, 3) m^2/s^2


@njit(nogil=True, cache=True, error_model="numpy")
def propagate(last, travel, damping, noise, prior):
    """F P F' + Q, block by block, with F = [[I, travel I], [0, damping I]] and Q = noise (pp, pu, uu) times I.

    Args:
        last: :class:`CovarianceBlocks` of the last posterior.
        travel: seconds.
        damping: factor on the velocity.
        noise: (pp, pu, uu) in m^2, m^2/s and m^2/s^2.
        prior: :class:`CovarianceBlocks` out.
    """
    P_pp, P_pu, P_uu = last
    prior_pp, prior_pu, prior_uu = prior
    pp, pu, uu = noise
    for i in range(P_pp.shape[0]):
        for a in range(3):
            for b in range(3):
                u = P_uu[i, a, b]
                prior_pp[i, a, b] = P_pp[i, a, b] + travel * (P_pu[i, a, b] + P_pu[i, b, a]) + travel * travel * u
                prior_pu[i, a, b] = damping * (P_pu[i, a, b] + travel * u)
                prior_uu[i, a, b] = damping * damping * u
            prior_pp[i, a, a] += pp
            prior_pu[i, a, a] += pu
            prior_uu[i, a, a] += uu


@njit(nogil=True, cache=True, error_model="numpy")
def means(position, velocity, center, mean):
    """Means of (V, 3) ``position``, metres, and ``velocity``, m/s, into (3,) ``center`` and ``mean``."""
    n = position.shape[0]
    for a in range(3):
        x, u = 0.0, 0.0
        for i in range(n):
            x += position[i, a]
            u += velocity[i, a]
        center[a], mean[a] = x / n, u / n


@njit(nogil=True, cache=True, error_model="numpy")
def moments(position, velocity, center, inertia, momentum):
    """Inertia and angular momentum of vertices of mass 1 about ``center``.

    Args:
        position, velocity: (V, 3) m and m/s; the velocities' mean does not matter.
        center: (3,) m, mean of the positions.
        inertia, momentum: (3, 3) m^2 and (3,) m^2/s, out.

    Returns:
        Sum of |u|^2, m^2/s^2.
    """
    xx, yy, zz, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    momentum[:] = 0.0
    square = 0.0
    for i in range(position.shape[0]):
        x, y, z = position[i, 0] - center[0], position[i, 1] - center[1], position[i, 2] - center[2]
        u, v, w = velocity[i, 0], velocity[i, 1], velocity[i, 2]
        xx, yy, zz, xy, xz, yz = xx + x * x, yy + y * y, zz + z * z, xy + x * y, xz + x * z, yz + y * z
        momentum[0] += y * w - z * v
        momentum[1] += z * u - x * w
        momentum[2] += x * v - y * u
        square += u * u + v * v + w * w
    inertia[0, 0], inertia[1, 1], inertia[2, 2] = yy + zz, xx + zz, xx + yy
    inertia[0, 1] = inertia[1, 0] = -xy
    inertia[0, 2] = inertia[2, 0] = -xz
    inertia[1, 2] = inertia[2, 1] = -yz
    return square


@njit(nogil=True, cache=True, error_model="numpy")
def angular_velocity(inertia, momentum, turning):
    """Solves inertia turning = momentum, ``inertia`` made definite by a billionth; (3, 3), (3,) and (3,) out, rad/s.

    Returns:
        turning . inertia turning, m^2/s^2.
    """
    least = 1e-9 * (inertia[0, 0] + inertia[1, 1] + inertia[2, 2]) + 1e-30
    a, b, c = inertia[0, 0] + least, inertia[1, 1] + least, inertia[2, 2] + least
    a, b, c, d, e, f = invert3(a, b, c, inertia[0, 1], inertia[0, 2], inertia[1, 2])
    x, y, z = momentum[0], momentum[1], momentum[2]
    turning[0], turning[1], turning[2] = a * x + d * y + e * z, d * x + b * y + f * z, e * x + f * y + c * z
    energy = 0.0
    for i in range(3):
        for j in range(3):
            energy += turning[i] * inertia[i, j] * turning[j]
    return energy


@njit(nogil=True, cache=True, error_model="numpy")
def rotation_matrix(vector, factor, rotation):
    """Matrix (3, 3), out, of the rotation vector factor (3,) ``vector``, in radians, through a quaternion."""
    x, y, z = factor * vector[0], factor * vector[1], factor * vector[2]
    angle = sqrt(x * x + y * y + z * z)
    half_sine = 0.5 - angle**2 / 48 + angle**4 / 3840 if angle <= SMALL_ANGLE else sin(angle / 2) / angle
    x, y, z, w = half_sine * x, half_sine * y, half_sine * z, cos(angle / 2)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = xx - yy - zz + ww, 2 * (x * y - z * w), 2 * (x * z + y * w)
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = 2 * (x * y + z * w), -xx + yy - zz + ww, 2 * (y * z - x * w)
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), -xx - yy + zz + ww


@njit(nogil=True, cache=True, error_model="numpy")
def move_rigidly(position, velocity, motion, rotation, rigid, own, moved, moved_velocity):
    """Moves vertices with a rigid motion, and with what of their velocities is not of it.

    Args:
        position, velocity: (V, 3) m and m/s.
        motion: centre (m), its velocity (m/s) and the angular velocity (rad/s), (3,) each.
        rotation: (3, 3) of the motion.
        rigid, own: (seconds of travel, factor on the velocity) of the rigid motion, and of the rest of the velocity.
        moved, moved_velocity: (V, 3) out.
    """
    center, mean, turning = motion
    travel, kept = rigid
    own_travel, own_kept = own
    wx, wy, wz = turning
    for i in range(position.shape[0]):
        x, y, z = position[i, 0] - center[0], position[i, 1] - center[1], position[i, 2] - center[2]
        u = velocity[i, 0] - mean[0] - (wy * z - wz * y)
        v = velocity[i, 1] - mean[1] - (wz * x - wx * z)
        w = velocity[i, 2] - mean[2] - (wx * y - wy * x)
        x, y, z = x + own_travel * u, y + own_travel * v, z + own_travel * w
        for a in range(3):
            moved[i, a] = rotation[a, 0] * x + rotation[a, 1] * y + rotation[a, 2] * z
            moved_velocity[i, a] = own_kept * (rotation[a, 0] * u + rotation[a, 1] * v + rotation[a, 2] * w)
        x, y, z = moved[i, 0], moved[i, 1], moved[i, 2]
        moved_velocity[i, 0] += kept * (mean[0] + wy * z - wz * y)
        moved_velocity[i, 1] += kept * (mean[1] + wz * x - wx * z)
        moved_velocity[i, 2] += kept * (mean[2] + wx * y - wy * x)
        for a in range(3):
            moved[i, a] += center[a] + travel * mean[a]

"""Stage D, adaptation (paper, sections 2.3 and 2.7): the measurement variance along each normal follows the residuals."""

from math import sqrt
from typing import NamedTuple

from numba import njit

from ddakf.kernels.symmetric import along


class Recursion(NamedTuple):
    """r <- clamp(alpha r + (1 - alpha) (sample + epsilon), lowest, highest) of a variance r."""

    alpha: float  # share of the old variance
    epsilon: float  # m^2
    lowest: float  # m^2
    highest: float  # m^2


@njit(nogil=True, cache=True, error_model="numpy")
def adapt_along_normals(position, target, normal, used, P, recursion, R):
    """R <- S R S with S = I + (s - 1) n n', and s such that n' R n follows e^2 + min(n' P n, n' R n), e = n . (z - x).

    Args:
        position: (V, 3) x, the estimate, metres.
        target, normal: (V, 3) z and n of the measurements, metres, unit.
        used: (V,) bool; R of the other vertices stays.
        P: (V, 3, 3) last posterior covariance, m^2.
        recursion: :class:`Recursion`.
        R: (V, 3, 3) m^2, in and out.
    """
    alpha, epsilon, lowest, highest = recursion
    for i in range(R.shape[0]):
        if not used[i]:
            continue
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        e = (target[i, 0] - position[i, 0]) * x + (target[i, 1] - position[i, 1]) * y + (target[i, 2] - position[i, 2]) * z
        vx = R[i, 0, 0] * x + R[i, 0, 1] * y + R[i, 0, 2] * z
        vy = R[i, 1, 0] * x + R[i, 1, 1] * y + R[i, 1, 2] * z
        vz = R[i, 2, 0] * x + R[i, 2, 1] * y + R[i, 2, 2] * z
        old = vx * x + vy * y + vz * z
        left = min(along(P[i], x, y, z), old)
        new = min(max(alpha * old + (1.0 - alpha) * (e * e + left + epsilon), lowest), highest)
        s = sqrt(new / old)
        # S R S = R + (s - 1)(n v' + v n') + (s - 1)^2 old n n' with v = R n
        t = s - 1.0
        q = t * t * old
        R[i, 0, 0] += 2.0 * t * x * vx + q * x * x
        R[i, 1, 1] += 2.0 * t * y * vy + q * y * y
        R[i, 2, 2] += 2.0 * t * z * vz + q * z * z
        xy = t * (x * vy + y * vx) + q * x * y
        xz = t * (x * vz + z * vx) + q * x * z
        yz = t * (y * vz + z * vy) + q * y * z
        R[i, 0, 1] += xy
        R[i, 1, 0] += xy
        R[i, 0, 2] += xz
        R[i, 2, 0] += xz
        R[i, 1, 2] += yz
        R[i, 2, 1] += yz

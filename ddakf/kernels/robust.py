"""Stage C, robustness (paper, section 2.5)."""

import numpy as np
from numba import njit

from ddakf.kernels.symmetric import along

NORMAL_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


@njit(nogil=True, cache=True, error_model="numpy")
def along_normals(position, target, normal, R, squared, variance):
    """(V,) out: (n . (z - x))^2 and n' R n."""
    for i in range(position.shape[0]):
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        d = (target[i, 0] - position[i, 0]) * x + (target[i, 1] - position[i, 1]) * y + (target[i, 2] - position[i, 2]) * z
        squared[i] = d * d
        variance[i] = along(R[i], x, y, z)


@njit(nogil=True, cache=True, error_model="numpy")
def scale(found, squared, variance):
    """Robust variance of the (V,) ``squared`` residuals that were found, or the median of their ``variance`` if that is more."""
    n = 0
    mine = np.empty(squared.shape[0])
    for i in range(squared.shape[0]):
        if found[i]:
            mine[n] = squared[i]
            n += 1
    scale2 = NORMAL_MAD**2 * np.median(mine[:n])
    more = 0
    for i in range(squared.shape[0]):
        more += int(found[i] and variance[i] > scale2)
    if 2 * more < n:
        return scale2
    n = 0
    for i in range(squared.shape[0]):
        if found[i]:
            mine[n] = variance[i]
            n += 1
    return max(scale2, np.median(mine[:n]))


@njit(nogil=True, cache=True, error_model="numpy")
def bisquare(found, squared, variance, least, cutoff, gate, weight):
    """(V,) weight out: Tukey's of squared / max(variance, least), zero beyond the gate and where nothing was found."""
    for i in range(weight.shape[0]):
        ratio = squared[i] / max(variance[i], least)
        rest = max(1.0 - ratio / (cutoff * cutoff), 0.0)
        weight[i] = rest * rest if found[i] and not ratio > gate else 0.0

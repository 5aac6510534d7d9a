"""Stage C, robustness (paper, section 2.5): residuals along the normals, their robust scale, and Tukey's weights."""

import numpy as np
from numba import njit

from ddakf.kernels.symmetric import along

NORMAL_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


@njit(nogil=True, cache=True, error_model="numpy")
def along_normals(position, target, normal, R, squared, variance):
    """Squared residuals (n . (z - x))^2 and their variances n' R n.

    Args:
        position: (V, 3) x, metres.
        target, normal: (V, 3) z and n of the measurements, metres, unit.
        R: (V, 3, 3) m^2.
        squared, variance: (V,) m^2, out.
    """
    for i in range(position.shape[0]):
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        d = (target[i, 0] - position[i, 0]) * x + (target[i, 1] - position[i, 1]) * y + (target[i, 2] - position[i, 2]) * z
        squared[i] = d * d
        variance[i] = along(R[i], x, y, z)


@njit(nogil=True, cache=True, error_model="numpy")
def median_of(values, chosen):
    """Median of the chosen ones of (N,) values, one at least."""
    n, some = 0, np.empty(values.shape[0])
    for i in range(values.shape[0]):
        if chosen[i]:
            some[n] = values[i]
            n += 1
    return np.median(some[:n])


@njit(nogil=True, cache=True, error_model="numpy")
def scale(found, squared, variance):
    """Robust variance of residuals from their median absolute deviation, at least the median of their variances.

    Args:
        found: (V,) bool, vertices with a measurement.
        squared, variance: (V,) of :func:`along_normals`, m^2.

    Returns:
        Variance, m^2.
    """
    scale2 = NORMAL_MAD**2 * median_of(squared, found)
    more = count = 0
    for i in range(squared.shape[0]):
        count += int(found[i])
        more += int(found[i] and variance[i] > scale2)
    return scale2 if 2 * more < count else max(scale2, median_of(variance, found))


@njit(nogil=True, cache=True, error_model="numpy")
def bisquare(found, squared, variance, least, cutoff, gate, weight):
    """Tukey's bisquare weight of d^2 = squared / max(variance, least).

    Args:
        found: (V,) bool.
        squared, variance: (V,) m^2.
        least: m^2.
        cutoff: d from which the weight is zero.
        gate: d^2 beyond which the weight is zero.
        weight: (V,) out, zero without a measurement.
    """
    for i in range(weight.shape[0]):
        ratio = squared[i] / max(variance[i], least)
        rest = max(1.0 - ratio / (cutoff * cutoff), 0.0)
        weight[i] = rest * rest if found[i] and not ratio > gate else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def weigh_heights(height, chosen, least, cutoff, weight):
    """Tukey's weights of heights, in units of their robust scale, which is returned: ``least`` metres or more.

    Args:
        height: (P,) metres.
        chosen: (P,) bool, those that count, one at least.
        least: metres.
        cutoff: in units of the scale.
        weight: (P,) out, 0 of the others.
    """
    size = max(NORMAL_MAD * median_of(np.abs(height), chosen), least)
    for i in range(height.shape[0]):
        ratio = height[i] / size / cutoff
        inside = max(1.0 - ratio * ratio, 0.0)
        weight[i] = inside * inside if chosen[i] else 0.0
    return size

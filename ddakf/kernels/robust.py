"""Stage C, robustness (paper, section 2.5)."""

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def along_normals(position, target, normal, R, squared, variance):
    """(V,) out: (n . (z - x))^2 and n' R n."""
    for i in range(position.shape[0]):
        x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
        d = (target[i, 0] - position[i, 0]) * x + (target[i, 1] - position[i, 1]) * y + (target[i, 2] - position[i, 2]) * z
        squared[i] = d * d
        variance[i] = (
            R[i, 0, 0] * x * x + R[i, 1, 1] * y * y + R[i, 2, 2] * z * z
            + 2.0 * (R[i, 0, 1] * x * y + R[i, 0, 2] * x * z + R[i, 1, 2] * y * z)
        )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def bisquare(found, squared, variance, least, cutoff, gate, weight):
    """(V,) weight out: Tukey's of squared / max(variance, least), zero beyond the gate and where nothing was found."""
    for i in range(weight.shape[0]):
        ratio = squared[i] / max(variance[i], least)
        rest = max(1.0 - ratio / (cutoff * cutoff), 0.0)
        weight[i] = rest * rest if found[i] and not ratio > gate else 0.0

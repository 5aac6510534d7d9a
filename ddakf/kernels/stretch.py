"""Stage E, stretch (paper, section 2.4): r = |w| - 1 with w = sum_a c_a p_a, and dr/dp_a = c_a w / |w|."""

from math import sqrt

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def linearize(positions, stencil, coefficient, residual, jacobian):
    """Residual (C,) and Jacobian (C, 3, 3) 1/m of every constraint, out.

    Args:
        positions: (V, 3) metres.
        stencil: (C, 3) corners of a triangle.
        coefficient: (C, 3) c_a, 1/m.
    """
    for c in range(stencil.shape[0]):
        i, j, k = stencil[c, 0], stencil[c, 1], stencil[c, 2]
        ci, cj, ck = coefficient[c, 0], coefficient[c, 1], coefficient[c, 2]
        x = ci * positions[i, 0] + cj * positions[j, 0] + ck * positions[k, 0]
        y = ci * positions[i, 1] + cj * positions[j, 1] + ck * positions[k, 1]
        z = ci * positions[i, 2] + cj * positions[j, 2] + ck * positions[k, 2]
        length = sqrt(x * x + y * y + z * z)
        residual[c] = length - 1.0
        # a tangent of no length has no direction: full residual, no force, until something else moves it
        scale = 1.0 / length if length > 1e-12 else 0.0
        x, y, z = x * scale, y * scale, z * scale
        jacobian[c, 0, 0], jacobian[c, 0, 1], jacobian[c, 0, 2] = ci * x, ci * y, ci * z
        jacobian[c, 1, 0], jacobian[c, 1, 1], jacobian[c, 1, 2] = cj * x, cj * y, cj * z
        jacobian[c, 2, 0], jacobian[c, 2, 1], jacobian[c, 2, 2] = ck * x, ck * y, ck * z

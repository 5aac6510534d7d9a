"""Stage E, shear (paper, section 2.4).

r = w_u . w_v with w_u = sum_a u_a p_a and w_v = sum_a v_a p_a, and dr/dp_a = u_a w_v + v_a w_u.
"""

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def linearize(positions, stencil, warp, weft, residual, jacobian):
    """Residual (C,) and Jacobian (C, 3, 3) 1/m of every triangle, out.

    Args:
        positions: (V, 3) metres.
        stencil: (C, 3) corners.
        warp, weft: (C, 3) coefficients u_a and v_a, 1/m.
    """
    for c in range(stencil.shape[0]):
        i, j, k = stencil[c, 0], stencil[c, 1], stencil[c, 2]
        ui, uj, uk = warp[c, 0], warp[c, 1], warp[c, 2]
        vi, vj, vk = weft[c, 0], weft[c, 1], weft[c, 2]
        r = 0.0
        for a in range(3):
            pi, pj, pk = positions[i, a], positions[j, a], positions[k, a]
            wu = ui * pi + uj * pj + uk * pk
            wv = vi * pi + vj * pj + vk * pk
            r += wu * wv
            jacobian[c, 0, a] = ui * wv + vi * wu
            jacobian[c, 1, a] = uj * wv + vj * wu
            jacobian[c, 2, a] = uk * wv + vk * wu
        residual[c] = r

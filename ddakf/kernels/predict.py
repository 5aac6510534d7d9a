"""Stage A, prediction (paper, section 2.2)."""

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def propagate(P_pp, P_pu, P_uu, travel, damping, noise, prior_pp, prior_pu, prior_uu):
    """F P F' + Q, block by block, with F = [[I, travel I], [0, damping I]] and Q = noise (pp, pu, uu) times I.

    All blocks are (V, 3, 3); the last three are written.
    """
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

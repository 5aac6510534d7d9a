"""Stage A, prediction (paper, section 2.2): the covariance of position and velocity after a time step."""

from typing import NamedTuple

import numpy as np
from numba import njit


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

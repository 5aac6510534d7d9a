"""Eight neighbouring numbers of a row, read and written as one vector.

All are read before any is written: the compiler cannot tell whether two arrays overlap.
"""

import numpy as np
from numba import njit

LANES = 8
I, II, III, IV, V, VI, VII = (np.uint64(i) for i in range(1, LANES))  # unsigned: an index that needs no check of its sign


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def load_lanes(row, k):
    """The LANES numbers of a row from k on."""
    return row[k], row[k + I], row[k + II], row[k + III], row[k + IV], row[k + V], row[k + VI], row[k + VII]


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def store_lanes(row, k, values):
    """Writes LANES numbers into a row from k on."""
    a, b, c, d, e, f, g, h = values
    row[k], row[k + I], row[k + II], row[k + III] = a, b, c, d
    row[k + IV], row[k + V], row[k + VI], row[k + VII] = e, f, g, h

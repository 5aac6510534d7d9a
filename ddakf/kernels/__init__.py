"""Compiled kernels: numba, a module per stage or step of one, same stem. Importing this package sets where code is cached.

A change here compiles every kernel again. The named tuples that kernels take are declared beside them.
"""

import numba

from ddakf.kernels import cache

cache.install()
# rows padded to four numbers become one vector: without it the sums over one-rings take twice as long
numba.config.SLP_VECTORIZE = 1

FAST = {"reassoc", "contract", "arcp", "nsz"}  # sums in any order and fused; what is not finite stays so, to be refused later

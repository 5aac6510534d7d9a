"""Rigid motion: sums over vertices, from which the rigid motion that fits them best follows (Kabsch 1976)."""

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def moments(before, after, seen, cluster, out):
    """Sums over the seen vertices of each cluster: their number, both places, and the products of their coordinates.

    Args:
        before: (V, 3) metres, places before the motion.
        after: (V, 3) metres, places after it.
        seen: (V,) bool.
        cluster: (V,) of each vertex, in [0, K).
        out: (K, 16) out.
    """
    out[:] = 0.0
    for i in range(after.shape[0]):
        if seen[i]:
            row = out[cluster[i]]
            row[0] += 1.0
            for a in range(3):
                row[1 + a] += before[i, a]
                row[4 + a] += after[i, a]
                for b in range(3):
                    row[7 + 3 * a + b] += before[i, a] * after[i, b]

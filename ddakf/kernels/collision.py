"""Collision: r = min(0, n . (p - q) - gap), dr/dp = n where it is negative."""

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def linearize(positions, face, point, normal, gap, area, residual, jacobian, weight):
    for i in range(positions.shape[0]):
        r = 0.0
        if face[i] >= 0:
            for a in range(3):
                r += normal[i, a] * (positions[i, a] - point[i, a])
            r -= gap[i]
        touching = r < 0.0
        residual[i] = r if touching else 0.0
        weight[i] = area[i] if touching else 0.0
        for a in range(3):
            jacobian[i, 0, a] = normal[i, a] if touching else 0.0

"""Stage E, body collision (paper, section 2.4): r = min(0, n . (p - q) - gap), dr/dp = n where r is negative."""

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def linearize(position, contact, gap, area, residual, jacobian, weight):
    """Residual, Jacobian and weight of every vertex; zero where it does not touch the body.

    Args:
        position: (V, 3) metres.
        contact: the ``Contact`` of the vertices; its faces, points q and normals n are read.
        gap: (V,) metres.
        area: (V,) m^2, weight of a vertex that touches.
        residual: (V,) out, metres, at most 0.
        jacobian: (V, 1, 3) out.
        weight: (V,) out, m^2.
    """
    face, point, normal = contact.face, contact.point, contact.normal
    for i in range(position.shape[0]):
        r = 0.0
        if face[i] >= 0:
            for a in range(3):
                r += normal[i, a] * (position[i, a] - point[i, a])
            r -= gap[i]
        touching = r < 0.0
        residual[i] = r if touching else 0.0
        weight[i] = area[i] if touching else 0.0
        for a in range(3):
            jacobian[i, 0, a] = normal[i, a] if touching else 0.0

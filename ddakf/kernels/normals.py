"""Normals of vertices, as every stage uses them."""

from math import sqrt

import numpy as np
from numba import njit

from ddakf.kernels import FAST


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def vertex_normals(position, faces, normal):
    """Area-weighted unit normals of vertices.

    Args:
        position: (V, 3) metres.
        faces: (F, 3).
        normal: (V, 3) out, zero where the adjacent faces have no area.
    """
    normal[:] = 0.0
    for f in range(faces.shape[0]):
        i, j, k = np.uint64(faces[f, 0]), np.uint64(faces[f, 1]), np.uint64(faces[f, 2])
        x, y, z = position[i, 0], position[i, 1], position[i, 2]
        ax, ay, az = position[j, 0] - x, position[j, 1] - y, position[j, 2] - z
        bx, by, bz = position[k, 0] - x, position[k, 1] - y, position[k, 2] - z
        cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            # all three are read before any is written: the compiler makes vectors of them
            x, y, z = normal[v, 0] + cx, normal[v, 1] + cy, normal[v, 2] + cz
            normal[v, 0], normal[v, 1], normal[v, 2] = x, y, z
    for v in range(normal.shape[0]):
        x, y, z = normal[v, 0], normal[v, 1], normal[v, 2]
        length = sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 1e-30 else 0.0
        normal[v, 0], normal[v, 1], normal[v, 2] = x * scale, y * scale, z * scale

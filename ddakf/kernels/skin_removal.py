"""Which points lie apart from the garment."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def touches(vertices, first, last, x, y, z, squared):
    """Whether one of the vertices first..last - 1 of (3, V) is nearer to a point than a squared radius."""
    for k in range(first, last):
        if (vertices[0, k] - x) ** 2 + (vertices[1, k] - y) ** 2 + (vertices[2, k] - z) ** 2 < squared:
            return True
    return False


@njit(nogil=True, cache=True, error_model="numpy")
def apart(points, vertices, start, origin, cell, dims, radius, out):
    """Whether no vertex lies within ``radius`` of a point.

    Args:
        points: (N, 3) metres.
        vertices: (3, V) float32 sorted by cell, relative to origin.
        start, origin, cell, dims: the grid of the vertices; its cells are at least ``radius`` wide.
        radius: metres.
        out: (N,) bool out.
    """
    inverse, squared = 1.0 / cell, radius * radius
    nx, ny, nz = dims[0], dims[1], dims[2]
    for n in range(points.shape[0]):
        out[n] = True
        x, y, z = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        if min(x, y, z) < -radius or x > nx * cell + radius or y > ny * cell + radius or z > nz * cell + radius:
            continue
        ix, iy, iz = int(np.floor(x * inverse)), int(np.floor(y * inverse)), int(np.floor(z * inverse))
        if 0 <= ix < nx and 0 <= iy < ny and 0 <= iz < nz:  # most often there is one in the same cell
            c = (ix * ny + iy) * nz + iz
            if touches(vertices, start[c], start[c + 1], x, y, z, squared):
                out[n] = False
                continue
        z0, z1 = max(int(np.floor((z - radius) * inverse)), 0), min(int(np.floor((z + radius) * inverse)), nz - 1)
        if z0 > z1:
            continue
        for jx in range(max(ix - 1, 0), min(ix + 2, nx)):
            for jy in range(max(iy - 1, 0), min(iy + 2, ny)):
                row = (jx * ny + jy) * nz
                if out[n] and touches(vertices, start[row + z0], start[row + z1 + 1], x, y, z, squared):
                    out[n] = False

"""Skin removal: the points of a cloud that are near no vertex of the garment."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def any_near(vertices, first, last, x, y, z, squared):
    """Whether one of the vertices first..last - 1 of (3, V), metres, is nearer to (x, y, z) than the ``squared`` radius, m^2."""
    for k in range(first, last):
        if (vertices[0, k] - x) ** 2 + (vertices[1, k] - y) ** 2 + (vertices[2, k] - z) ** 2 < squared:
            return True
    return False


@njit(nogil=True, cache=True, error_model="numpy")
def far_from_vertices(points, vertices, grid, radius, far):
    """Marks the points without a vertex within ``radius``.

    Args:
        points: (N, 3) metres.
        vertices: (3, V) float32 sorted by cell, relative to the grid's origin, metres.
        grid: ``Grid`` of the vertices; its cells are at least ``radius`` wide.
        radius: metres.
        far: (N,) bool out.
    """
    start, origin, cell, dims = grid
    inverse, squared = 1.0 / cell, radius * radius
    nx, ny, nz = dims[0], dims[1], dims[2]
    for n in range(points.shape[0]):
        far[n] = True
        x, y, z = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        if min(x, y, z) < -radius or x > nx * cell + radius or y > ny * cell + radius or z > nz * cell + radius:
            continue
        ix, iy, iz = int(np.floor(x * inverse)), int(np.floor(y * inverse)), int(np.floor(z * inverse))
        if 0 <= ix < nx and 0 <= iy < ny and 0 <= iz < nz:  # most points have a vertex in their own cell
            c = (ix * ny + iy) * nz + iz
            if any_near(vertices, start[c], start[c + 1], x, y, z, squared):
                far[n] = False
                continue
        z0, z1 = max(int(np.floor((z - radius) * inverse)), 0), min(int(np.floor((z + radius) * inverse)), nz - 1)
        if z0 > z1:
            continue
        for jx in range(max(ix - 1, 0), min(ix + 2, nx)):
            for jy in range(max(iy - 1, 0), min(iy + 2, ny)):
                row = (jx * ny + jy) * nz
                if far[n] and any_near(vertices, start[row + z0], start[row + z1 + 1], x, y, z, squared):
                    far[n] = False

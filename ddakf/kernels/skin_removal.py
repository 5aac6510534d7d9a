"""Skin removal: the points of a cloud that are near no vertex of the garment."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def cell_along(x, inverse, n):
    """Cell of a coordinate x along an axis of n cells, 1 / ``inverse`` metres wide; the outermost extend without end."""
    return int(np.floor(min(max(x * inverse, 0.0), n - 1.0)))


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
        grid: ``Grid`` of the vertices; its cells are at least ``radius`` wide, those at the rim extend without end.
        radius: metres.
        far: (N,) bool out.
    """
    start, origin, cell, dims = grid
    inverse, squared = 1.0 / cell, radius * radius
    nx, ny, nz = dims[0], dims[1], dims[2]
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(vertices.shape[1]):
        for a in range(3):
            low[a], high[a] = min(low[a], vertices[a, k] - radius), max(high[a], vertices[a, k] + radius)
    for n in range(points.shape[0]):
        far[n] = True
        x, y, z = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        if not (low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]):
            continue
        ix, iy, iz = cell_along(x, inverse, nx), cell_along(y, inverse, ny), cell_along(z, inverse, nz)
        c = (ix * ny + iy) * nz + iz  # most points have a vertex in their own cell
        if any_near(vertices, start[c], start[c + 1], x, y, z, squared):
            far[n] = False
            continue
        z0, z1 = cell_along(z - radius, inverse, nz), cell_along(z + radius, inverse, nz)
        for jx in range(max(ix - 1, 0), min(ix + 2, nx)):
            for jy in range(max(iy - 1, 0), min(iy + 2, ny)):
                row = (jx * ny + jy) * nz
                if far[n] and any_near(vertices, start[row + z0], start[row + z1 + 1], x, y, z, squared):
                    far[n] = False

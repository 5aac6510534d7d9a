"""Preprocessing: the vertex of the garment that is nearest to each point."""

from math import sqrt

import numpy as np
from numba import njit

from ddakf.kernels.skin_removal import cell_along


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_vertices(points, position, index, grid, reach, nearest, distance):
    """Finds the vertex nearest to each point, rings of cells outward.

    Args:
        points: (N, 3) metres.
        position: (V, 3) metres.
        index: (V,) int32 vertices sorted by cell.
        grid: ``Grid`` of the vertices; its cells at the rim extend without end.
        reach: metres.
        nearest: (N,) int32 out, -1 where none is within the reach.
        distance: (N,) out, metres; infinite there.
    """
    start, origin, cell, dims = grid
    nx, ny, nz = dims[0], dims[1], dims[2]
    rings = int(np.ceil(reach / cell))
    for k in range(points.shape[0]):
        px, py, pz = np.float64(points[k, 0]), np.float64(points[k, 1]), np.float64(points[k, 2])
        fx, fy, fz = (px - origin[0]) / cell, (py - origin[1]) / cell, (pz - origin[2]) / cell
        ix, iy, iz = cell_along(fx, 1.0, nx), cell_along(fy, 1.0, ny), cell_along(fz, 1.0, nz)
        margin = cell * max(min(fx - ix, ix + 1 - fx, fy - iy, iy + 1 - fy, fz - iz, iz + 1 - fz), 0.0)
        best, winner = reach * reach, -1
        for ring in range(1, rings + 1):
            z0, z1 = max(iz - ring, 0), min(iz + ring, nz - 1)
            for jx in range(max(ix - ring, 0), min(ix + ring + 1, nx)):
                for jy in range(max(iy - ring, 0), min(iy + ring + 1, ny)):
                    row = (jx * ny + jy) * nz
                    for m in range(start[row + z0], start[row + z1 + 1]):
                        v = index[m]
                        d2 = (position[v, 0] - px) ** 2 + (position[v, 1] - py) ** 2 + (position[v, 2] - pz) ** 2
                        if d2 < best:
                            best, winner = d2, v
            if best <= (ring * cell + margin) ** 2:  # no vertex of the next ring is nearer
                break
        nearest[k] = winner
        distance[k] = np.inf if winner < 0 else sqrt(best)

"""Which points lie apart from the garment."""

from numba import njit


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
    inverse = 1.0 / cell
    for n in range(points.shape[0]):
        out[n] = True
        px, py, pz = points[n, 0] - origin[0], points[n, 1] - origin[1], points[n, 2] - origin[2]
        if px < -radius or py < -radius or pz < -radius:
            continue
        z0, z1 = max(int((pz - radius) * inverse), 0), min(int((pz + radius) * inverse), dims[2] - 1)
        if z0 > z1:
            continue
        for jx in range(max(int((px - radius) * inverse), 0), min(int((px + radius) * inverse), dims[0] - 1) + 1):
            for jy in range(max(int((py - radius) * inverse), 0), min(int((py + radius) * inverse), dims[1] - 1) + 1):
                row = (jx * dims[1] + jy) * dims[2]
                for k in range(start[row + z0], start[row + z1 + 1]):
                    d2 = (vertices[0, k] - px) ** 2 + (vertices[1, k] - py) ** 2 + (vertices[2, k] - pz) ** 2
                    if d2 < radius * radius:
                        out[n] = False
                        break
                if not out[n]:
                    break
            if not out[n]:
                break

"""Templates from a depth image: the visible surface as a grid mesh, enough to track any recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.evaluation.sensors.camera import Camera
from ddakf.mesh import Mesh

JUMP = 0.06  # m: neighbouring pixels farther apart in depth than this belong to different surfaces
SMOOTHING_RADIUS = 3  # pixels: evens out the depth steps of a structured-light sensor, 22 mm at 2.8 m
SMOOTHING_PASSES = 2  # of the template; a cloud has one
SMALLEST_SHARE = 0.05  # of the vertices: smaller components are left out


def template_from_depth(depth: np.ndarray, camera: Camera, vertices: int = 3000, jump: float = JUMP) -> Mesh:
    """Grid mesh of the surfaces in a depth image.

    The depth is smoothed within surfaces and resampled on a grid whose spacing gives the wanted number of vertices.
    No triangle spans a depth jump, and small components are left out.

    Args:
        depth: (H, W) metres; zero, negative or non-finite in pixels without a depth.
        camera: of the image.
        vertices: approximate number of the mesh's vertices.
        jump: least difference in depth between two surfaces, metres.

    Returns:
        A clean mesh in the world of the camera, faces counter-clockwise seen from the camera.

    Raises:
        InvalidArgument: too few pixels with a depth for a mesh.
    """
    smooth = smoothed(depth, jump)
    seen = smooth > 0
    inside = seen[:-1, :-1] & seen[1:, :-1] & seen[:-1, 1:] & seen[1:, 1:]
    if inside.sum() < 16:
        raise InvalidArgument("depth", "an object of at least 16 connected pixels", f"{seen.sum()} pixels with a depth")
    step = max(1.0, np.sqrt(inside.sum() / vertices))
    grid, grid_camera = _resampled(smooth, camera, step, jump)
    faces = _largest_components(_grid_faces(grid, jump), grid.size)
    if len(faces) == 0:
        raise InvalidArgument("depth", f"a surface without jumps of {jump:g} m, for {vertices} vertices", "none")
    number = np.cumsum(grid.ravel() > 0) - 1
    return Mesh.cleaned(grid_camera.unproject(grid), number[faces])[0]


def smoothed(depth: np.ndarray, jump: float, passes: int = SMOOTHING_PASSES) -> np.ndarray:
    """(H, W) depth averaged within a small window, with pixels less than ``jump`` away in depth; 0 where unseen."""
    z = np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)
    rows, columns = np.flatnonzero(z.any(axis=1)), np.flatnonzero(z.any(axis=0))
    if len(rows):
        window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        for _ in range(passes):
            z[window] = _smoothed_once(z[window], jump)
    return z


def _smoothed_once(z: np.ndarray, jump: float) -> np.ndarray:
    r, (height, width) = SMOOTHING_RADIUS, z.shape
    padded = np.pad(z, r)
    total, weight = np.zeros_like(z), np.zeros_like(z)
    for dv, du in np.ndindex(2 * r + 1, 2 * r + 1):
        other = padded[dv : dv + height, du : du + width]
        w = np.exp(-((dv - r) ** 2 + (du - r) ** 2) / r**2) * ((other > 0) & (np.abs(other - z) < jump))
        total += w * other
        weight += w
    return np.where(z > 0, total / np.maximum(weight, 1e-12), 0.0)


def _resampled(depth: np.ndarray, camera: Camera, step: float, jump: float) -> tuple[np.ndarray, Camera]:
    """The depth image with pixels ``step`` times as large (bilinear; 0 across jumps and borders), and its camera."""
    height, width = (int((n - 1) / step) for n in depth.shape)
    v, u = np.arange(height) * step, np.arange(width) * step
    row, column = v.astype(int)[:, None], u.astype(int)[None, :]
    b, a = (v - v.astype(int))[:, None], (u - u.astype(int))[None, :]
    corners = np.stack([depth[row + i, column + j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))])
    value = (1 - b) * ((1 - a) * corners[0] + a * corners[1]) + b * ((1 - a) * corners[2] + a * corners[3])
    value[(corners.min(axis=0) <= 0) | (np.ptp(corners, axis=0) > jump)] = 0
    i = camera.intrinsics
    scaled = replace(i, width=width, height=height, fx=i.fx / step, fy=i.fy / step, cx=i.cx / step, cy=i.cy / step)
    return value, replace(camera, intrinsics=scaled)


def _grid_faces(depth: np.ndarray, jump: float) -> np.ndarray:
    """(F, 3) indices into the pixels, two triangles per cell, counter-clockwise for the viewer; none across a jump."""
    index = np.arange(depth.size).reshape(depth.shape)
    a, b, c, d = (cells.ravel() for cells in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.column_stack([a, c, b]), np.column_stack([b, c, d])])
    z = depth.ravel()[faces]
    return faces[(z.min(axis=1) > 0) & (np.ptp(z, axis=1) < jump)]


def _largest_components(faces: np.ndarray, n_vertices: int) -> np.ndarray:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(n_vertices, n_vertices))
    component = connected_components(graph, directed=False)[1]
    size = np.bincount(component[np.unique(faces)], minlength=component.max() + 1)
    return faces[size[component[faces[:, 0]]] >= SMALLEST_SHARE * size.sum()]

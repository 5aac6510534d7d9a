"""Preprocessing, grid of the garment's vertices: points find the vertices near them."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from ddakf.kernels import preprocess as kernels
from ddakf.kernels import sensor_poses, vertex_search
from ddakf.kernels.preprocess import Grid

# Of a search, cells within its reach at most, of the mean distance of the vertices, and along each axis of the grid at most: they
# change its time, not its result.
RINGS, CELL_SPACINGS, CELLS = 8, 0.8, 127
CROWDED = 256  # most vertices of a cell that are searched; ordinary garments have a few, the largest a hundred
ASTRAY = 0.02  # share of the vertices at either end of an axis that may lie far from all others

FEW = 64  # most distinct rows that are told apart without sorting
GOLDEN = 0.6180339887  # its multiples fill [0, 1) evenly

_KEY = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)  # large odd numbers


class VertexGrid(NamedTuple):
    """Vertices sorted by grid cell."""

    vertices: np.ndarray  # (3, V) float32, relative to origin, m
    index: np.ndarray  # (V,) int32, number of each vertex in the mesh
    grid: Grid  # grid of the vertices


def vertex_grid(position: np.ndarray, cell: float, most: int) -> VertexGrid:
    """(V, 3) vertices, metres, in cells of ``cell`` metres, or larger ones where that were more than ``most`` along an axis.

    Vertices astray would leave all the others in one cell. The cells then fill the box of most vertices, and those at its rim
    extend without end. In a cell that a folded garment crowds nevertheless, an even sample of the vertices counts.
    """
    lower, upper = np.empty(3), np.empty(3)
    kernels.bounds(position, 0.0, lower, upper)
    (vertices, index, grid), fullest = _filled(position, (lower, upper), cell, most)
    if fullest <= CROWDED:
        return VertexGrid(vertices, index, grid)
    (vertices, index, grid), _ = _filled(position, np.quantile(position, (ASTRAY, 1.0 - ASTRAY), axis=0), cell, most)
    surplus = np.empty(len(position), bool)
    left = kernels.mark_surplus(grid.start, CROWDED, surplus)
    start, some, their_index = np.empty_like(grid.start), np.empty((3, left), np.float32), np.empty(left, np.int32)
    kernels.remove(grid.start, surplus, vertices, index, start, some, their_index)
    return VertexGrid(some, their_index, grid._replace(start=start))


def _filled(position: np.ndarray, box: tuple[np.ndarray, np.ndarray], cell: float, most: int) -> tuple[VertexGrid, int]:
    """The grid, and the most vertices that a cell holds."""
    lower, upper = box
    extent = upper - lower
    cell = max(cell, float(extent.max()) / most)
    dims = (extent / cell).astype(np.int64) + 1
    grid = Grid(np.empty(int(np.prod(dims)) + 2, np.int32), lower, cell, dims)
    vertices, index = np.empty((3, len(position)), np.float32), np.empty(len(position), np.int32)
    fullest = kernels.fill_grid(position, np.arange(len(position), dtype=np.int32), grid, vertices, index)
    return VertexGrid(vertices, index, grid), fullest


def spread_rows(n: int, count: int) -> np.ndarray:
    """At most ``count`` of n rows: one of each stretch, at a varying place in it. Rows at equal distances would, in an image,
    lie in a few columns."""
    if n <= count:
        return np.arange(n)
    at = np.arange(count)
    return ((at + at * GOLDEN % 1.0) * n / count).astype(np.int64)


def nearest_vertices(points: np.ndarray, position: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Index (N,) of the vertex nearest to each of (N, 3) points and its distance, metres; -1 and infinite beyond the reach.

    Args:
        points: (N, 3) metres.
        position: (V, 3) metres.
        reach: metres.
    """
    lower, upper = np.empty(3), np.empty(3)
    kernels.bounds(position, 0.0, lower, upper)
    width, height, depth = (upper - lower).tolist()
    spacing = sqrt(2.0 * (width * height + height * depth + depth * width) / len(position))  # of vertices on the sides of a box
    cell = min(max(CELL_SPACINGS * spacing, reach / RINGS), reach)
    _, index, grid = vertex_grid(position, cell, CELLS)
    nearest, away = np.empty(len(points), np.int32), np.empty(len(points))
    vertex_search.nearest_vertices(points, position, index, grid, reach, nearest, away)
    return nearest, away


def distinct(origins: np.ndarray) -> np.ndarray:
    """The distinct rows of (N, 3) in ascending order."""
    rows = origins[first_rows(origins)]
    return rows[np.lexsort(rows.T[::-1])] if len(rows) <= FEW else np.unique(rows, axis=0)


def first_rows(origins: np.ndarray) -> np.ndarray:
    """Indices of the first row of each kind in (N, 3); of more than FEW kinds one or few each, told apart by keys of 64 bits."""
    first = np.empty(FEW, np.int64)
    count = sensor_poses.first_rows(np.ascontiguousarray(origins), first)
    if count <= FEW:
        return first[:count]
    changes = np.flatnonzero(np.any(origins[1:] != origins[:-1], axis=1)) + 1
    starts = np.concatenate([[0], changes])
    rows = origins[starts] + 0.0  # a negative zero is a zero
    _, first = np.unique(rows.view(np.uint64) @ _KEY, return_index=True)
    return starts[first]

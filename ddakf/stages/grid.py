"""Preprocessing, grid of the garment's vertices: points find the vertices near them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.kernels import preprocess as kernels
from ddakf.kernels.preprocess import Grid


class VertexGrid(NamedTuple):
    """Vertices sorted by grid cell."""

    vertices: np.ndarray  # (3, V) float32, relative to origin, m
    index: np.ndarray  # (V,) int32, of each in the mesh
    grid: Grid  # of the vertices


def vertex_grid(position: np.ndarray, cell: float, most: int) -> VertexGrid:
    """(V, 3) vertices, metres, in cells of ``cell`` metres, or larger ones where that were more than ``most`` along an axis."""
    lower, upper = np.empty(3), np.empty(3)
    kernels.bounds(position, 0.0, lower, upper)
    extent = upper - lower
    cell = max(cell, float(extent.max()) / most)
    dims = (extent / cell).astype(np.int64) + 1
    grid = Grid(np.empty(int(np.prod(dims)) + 2, np.int32), lower, cell, dims)
    vertices, index = np.empty((3, len(position)), np.float32), np.empty(len(position), np.int32)
    kernels.fill_grid(position, np.arange(len(position), dtype=np.int32), grid, vertices, index)
    return VertexGrid(vertices, index, grid)


def distinct(origins: np.ndarray) -> np.ndarray:
    """The distinct rows of (N, 3), without sorting floats where there is one row or a few runs of them."""
    changes = np.flatnonzero(np.any(origins[1:] != origins[:-1], axis=1)) + 1
    return np.unique(origins[np.concatenate([[0], changes])], axis=0)

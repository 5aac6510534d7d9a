"""Preprocessing (paper, section 2.1): crop, one uniform grid, outlier removal, PCA planes."""

from __future__ import annotations

import numpy as np

from ddakf.config import Config, GridFilter, KnnFilter, NearestPoint, PlaneAssociation
from ddakf.kernels import preprocess as kernels
from ddakf.kernels.preprocess import Grid
from ddakf.stages import skin_removal
from ddakf.stages.grid import distinct
from ddakf.types import Cloud, FrameInput, Problem

MAX_CELLS = 2_000_000  # of a grid, so that stray points cannot exhaust the memory


def preprocess(problem: Problem) -> Problem:
    """The problem with its cloud: without skin, cropped to the predicted garment, without outliers, with fitted planes."""
    garment = skin_removal.remove_skin(problem.frame, problem, problem.prior.position, problem.config.skin_removal.hem_distance)
    return problem._replace(garment=garment, cloud=cloud(garment, problem.prior.position, problem.model.area, problem.config))


def cloud(frame: FrameInput, position: np.ndarray, area: float, config: Config) -> Cloud:
    """Crops to the neighbourhood of the predicted garment, removes outliers and fits planes.

    Args:
        frame: its points and sensors.
        position: (V, 3) predicted vertices, metres.
        area: of the garment, square metres; with the number of points it sets the cell size.
        config: which outlier filter, and how far measurements are sought.
    """
    points, sensor_origin = frame.points, frame.sensor_origin
    match config.associate:
        case PlaneAssociation(wide_gate=gate) | NearestPoint(gate=gate):
            margin = 2.0 * gate
    lower, upper, chosen = np.empty(3), np.empty(3), np.empty(len(points), np.int32)
    kernels.bounds(position, margin, lower, upper)
    chosen = chosen[: kernels.crop(points, lower, upper, chosen)]
    grid = _grid(points, chosen, (lower, upper), _cell_size(len(chosen), area, config.preprocess))
    if len(chosen):
        match config.preprocess:
            case GridFilter():
                grid = _drop_sparse(grid, config.preprocess)
            case KnnFilter():
                grid = _drop_far(grid, config.preprocess)
    sorted_points, index, start, origin, cell, dims = grid
    # a cloud denser than the garment is fitted with planes at the density that the garment can use
    stride = 1
    if isinstance(config.preprocess, GridFilter):
        stride = max(1, round(sorted_points.shape[1] / (config.preprocess.planes_per_vertex * len(position))))
    surfels = np.empty((6, -(-sorted_points.shape[1] // stride)), np.float32)
    kernels.fit_planes(sorted_points, Grid(*grid[2:]), config.preprocess.plane_radius * cell, stride, surfels)
    sensor = None
    if sensor_origin is not None:
        if sensor_origin.ndim == 1:
            sensor = per_point = sensor_origin[None, :]
        else:
            sensor, per_point = distinct(sensor_origin), sensor_origin[index[::stride]]
        kernels.orient_normals(surfels, per_point - origin)
    surfel_start = (start + (stride - 1)) // stride
    return Cloud(sorted_points, index, start, surfels, surfel_start, origin, cell, dims, sensor)


def _cell_size(count: int, area: float, config: GridFilter | KnnFilter) -> float:
    """Metres: cells of a surface of ``area`` square metres that hold about as many of ``count`` points as configured."""
    return float(np.sqrt(config.points_per_cell * area / max(count, 1)))


def _grid(points: np.ndarray, chosen: np.ndarray, box: tuple[np.ndarray, np.ndarray], cell: float):
    """Sorted points of the chosen ones in a box, their indices, cell starts, origin, cell size and dimensions."""
    if len(chosen) == 0:
        return np.empty((3, 0), np.float32), chosen, np.zeros(10, np.int32), np.zeros(3), 1.0, np.full(3, 2, np.int64)
    lower, upper = box
    origin = lower - 1e-6
    extent = upper - origin + 1e-6
    cell = max(cell, 1e-4, float(np.prod(np.maximum(extent, 1e-3) / MAX_CELLS ** (1 / 3))) ** (1 / 3))
    dims = np.maximum((extent / cell).astype(np.int64) + 1, 1)
    while np.prod(dims.astype(float)) > 2 * MAX_CELLS:
        cell *= 1.3
        dims = np.maximum((extent / cell).astype(np.int64) + 1, 1)
    start = np.empty(int(np.prod(dims)) + 2, np.int32)
    sorted_points = np.empty((3, len(chosen)), np.float32)
    index = np.empty(len(chosen), np.int32)
    kernels.fill_grid(points, chosen, Grid(start, origin, cell, dims), sorted_points, index)
    return sorted_points, index, start, origin, cell, dims


def _drop_sparse(grid, config: GridFilter):
    """The statistical filter, with neighbours sought for suspects alone.

    A point whose 27 cells hold a fair share of the median is an inlier. The statistics that the others are held against are of
    all points: suspects, and a sample of the rest.
    """
    points, index, start, _, _, dims = grid
    occupied, count, suspects, rest = (np.empty(len(index), np.int32) for _ in range(4))
    n = kernels.neighbourhood_counts(start, dims, occupied, count)
    n = kernels.split_suspects(start, occupied[:n], count[:n], config.suspect_share, suspects, rest)
    if n == 0:
        return grid
    suspects, rest = suspects[:n], rest[: len(index) - n]
    sample = rest[:: max(1, len(rest) // config.sample)]
    distance = np.empty(len(suspects) + len(sample))
    kernels.knn_mean_distances(
        points, np.concatenate([suspects, sample]), Grid(*grid[2:]), config.neighbours - 1, config.suspect_rings, distance
    )
    mine, others = distance[: len(suspects)], distance[len(suspects) :]
    total = len(index)
    mean = (mine.sum() + len(rest) * others.mean()) / total if len(others) else mine.mean()
    spread = np.square(mine - mean).sum() + (len(rest) * np.square(others - mean).mean() if len(others) else 0.0)
    removed = np.zeros(total, bool)
    # a clean cloud has little spread, and its sparser parts are no outliers
    removed[suspects[mine > max(mean + config.ratio * np.sqrt(spread / total), config.clean_factor * mean)]] = True
    return _without(grid, removed)


def _drop_far(grid, config: KnnFilter):
    """Rusu and Cousins 2011, as in Open3D: mean distance to the k nearest, the point itself among them."""
    points, index, start = grid[:3]
    if len(index) <= 1:
        return grid
    others = min(config.neighbours, len(index)) - 1
    mean = np.empty(len(index))
    kernels.knn_mean_distances(points, np.arange(len(index)), Grid(*grid[2:]), others, len(start), mean)
    mean *= others / (others + 1)
    return _without(grid, ~(mean < mean.mean() + config.ratio * mean.std(ddof=1)))


def _without(grid, removed: np.ndarray):
    points, index, start, origin, cell, dims = grid
    left = len(index) - np.count_nonzero(removed)
    if left == len(index):
        return grid
    new_start, new_points, new_index = np.empty_like(start), np.empty((3, left), np.float32), np.empty(left, np.int32)
    kernels.remove(start, removed, points, index, new_start, new_points, new_index)
    return new_points, new_index, new_start, origin, cell, dims

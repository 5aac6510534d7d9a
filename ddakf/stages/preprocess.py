"""Preprocessing (paper, section 2.1): crop, one uniform grid, outlier removal, PCA planes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.appearance import segmentation
from ddakf.config import Config, GridFilter, KnnFilter, NearestPoint, PlaneAssociation
from ddakf.kernels import preprocess as kernels
from ddakf.kernels.outliers import knn_mean_distances
from ddakf.kernels.preprocess import Grid
from ddakf.kernels.surface_points import Sample
from ddakf.stages import skin_removal
from ddakf.stages.grid import distinct, spread_rows
from ddakf.types import Cloud, FrameInput, Problem, Surfels

MAX_CELLS, CELLS_PER_POINT = 2_000_000, 32  # most cells of a grid: stray points cost neither memory nor time
# Most points of a cell, and most neighbours of a plane fit, that are used; in units of points_per_cell. One camera's clouds reach
# 8 and 65. A clump of more points says no more, and its cost would grow with the square of their number.
CROWDED, NEIGHBOURS = 13.0, 80.0
SPARSE_RINGS = 8  # search radius in the cells of the sparse surfels


class Density(NamedTuple):
    """The points that a cell of the garment's surface holds."""

    area: float  # of the garment, m^2
    points_per_cell: float
    widest: float = np.inf  # m, widest cell: in a sparse cloud cells hold fewer points instead
    least_per_cell: float = 0.0  # least points of a cell, however sparse the cloud

    def cell(self, count: int) -> float:
        """Metres: cells that hold about so many of ``count`` points.

        A plane that is fitted to wide cells lies inside a curved sleeve and flattens folds.
        """
        spacing = np.sqrt(self.area / max(count, 1))
        least = max(self.widest, np.sqrt(self.least_per_cell) * spacing)
        return float(min(np.sqrt(self.points_per_cell) * spacing, least))

    def doubled(self) -> Density:
        """Twice as many points in a cell."""
        return Density(self.area, 2.0 * self.points_per_cell)

    @property
    def most_per_cell(self) -> int:
        """Points of a cell that are used."""
        return max(1, int(CROWDED * self.points_per_cell))


def preprocess(problem: Problem) -> Problem:
    """The problem with its cloud: without skin and other things, cropped to the predicted garment, without outliers, with planes.

    A budget may leave a share of the points out of the frame.
    """
    problem = problem._replace(frame=thinned(problem.frame, problem.effort.points))
    garment = skin_removal.remove_skin(problem.frame, problem, problem.prior.position, problem.config.skin_removal.hem_distance)
    garment, config, model = segmentation.without_others(garment, problem), problem.config, problem.model
    planes = isinstance(config.associate, PlaneAssociation)
    samples = config.associate.wanted_points(model.area, model.edge_length) if planes else 0
    return problem._replace(garment=garment, cloud=cloud(garment, problem.prior.position, model.area, config, samples))


def thinned(frame: FrameInput, share: float) -> FrameInput:
    """The frame with so large a share of its points, spread over all."""
    if share >= 1.0:
        return frame
    return frame.only(spread_rows(len(frame.points), int(share * len(frame.points))))


def cloud(frame: FrameInput, position: np.ndarray, area: float, config: Config, samples: int = 0) -> Cloud:
    """Crops to the neighbourhood of the predicted garment, removes outliers and fits planes.

    Args:
        frame: its points and sensors.
        position: (V, 3) predicted vertices, metres.
        area: of the garment, square metres; with the number of points it sets the cell size.
        config: which outlier filter, and how far measurements are sought.
        samples: points that measure faces, at most.
    """
    points, sensor_origin = frame.points, frame.sensor_origin
    match config.associate:
        case PlaneAssociation(wide_gate=gate) | NearestPoint(gate=gate):
            margin = 2.0 * gate
    lower, upper, chosen = np.empty(3), np.empty(3), np.empty(len(points), np.int32)
    kernels.bounds(position, margin, lower, upper)
    chosen = chosen[: kernels.crop(points, lower, upper, chosen)]
    density = _density(area, config.preprocess)
    grid = _uncrowded(points, chosen, (lower, upper), density)
    if grid[0].size:
        match config.preprocess:
            case GridFilter():
                for _ in range(config.preprocess.doublings):
                    if not _noisy(grid, config.preprocess):
                        break
                    density = density.doubled()
                    grid = _uncrowded(points, chosen, (lower, upper), density)
                grid = _drop_sparse(grid, config.preprocess)
            case KnnFilter():
                grid = _drop_far(grid, config.preprocess)
    planes, sensor, stride = _planes(grid, len(position), sensor_origin, config.preprocess)
    surfels = Surfels(planes, Grid(*grid[2:])) if stride == 1 else _in_larger_cells(planes, Grid(*grid[2:]), stride)
    sparse = sample = None
    if isinstance(config.associate, PlaneAssociation):
        if surfels.grid.cell < gate / SPARSE_RINGS:
            sparse = _sparse(surfels, gate / SPARSE_RINGS, density)
        sample = _sample(grid, planes, stride, samples, sensor is not None)
    return Cloud(*grid[:3], *surfels, *grid[3:], sensor, sparse, sample)


def _density(area: float, config: GridFilter | KnnFilter) -> Density:
    """Of a garment with this area, square metres."""
    if isinstance(config, GridFilter):
        return Density(area, config.points_per_cell, config.widest_cell, config.least_per_cell)
    return Density(area, config.points_per_cell)


def _planes(grid, n_vertices: int, sensor_origin: np.ndarray | None, config: GridFilter | KnnFilter):
    """Surfels (6, S) of every ``stride``-th point of a grid, the sensors that their normals point to or None, and the stride.

    A cloud denser than the garment is fitted with planes at the density that the garment can use.
    """
    points, index, _, origin, cell, _ = grid
    stride = 1
    if isinstance(config, GridFilter):
        stride = max(1, round(points.shape[1] / (config.planes_per_vertex * n_vertices)))
    planes, sensor = np.empty((6, -(-points.shape[1] // stride)), np.float32), None
    neighbours = max(1, int(NEIGHBOURS * config.points_per_cell))
    kernels.fit_planes(points, Grid(*grid[2:]), config.plane_radius * cell, stride, neighbours, planes)
    if sensor_origin is not None:
        if sensor_origin.ndim == 1:
            sensor = per_point = sensor_origin[None, :]
        else:
            sensor, per_point = distinct(sensor_origin), sensor_origin[index[::stride]]
        kernels.orient_normals(planes, per_point - origin)
    return planes, sensor, stride


def _sample(grid, planes: np.ndarray, stride: int, most: int, oriented: bool) -> Sample | None:
    """At most so many of the points that have a surfel, spread over the grid, as they were measured; None of none."""
    count = planes.shape[1]
    if min(most, count) == 0:
        return None
    every = -(-count // most)
    point = np.ascontiguousarray(grid[0][:, :: stride * every].T + grid[3])  # or another kernel is compiled
    return Sample(point, np.ascontiguousarray(planes[3:, ::every].T, np.float64), oriented)


def _in_larger_cells(planes: np.ndarray, grid: Grid, stride: int) -> Surfels:
    """Surfels of every ``stride``-th point, sorted into cells that hold as many of them as the points' cells do points."""
    _, origin, cell, dims = grid
    larger = cell * float(np.sqrt(stride))
    dims = (dims * cell / larger).astype(np.int64) + 1
    start, index = np.empty(int(np.prod(dims)) + 2, np.int32), np.empty(planes.shape[1], np.int32)
    points, moved = np.ascontiguousarray(planes[:3].T), np.empty_like(planes)
    kernels.fill_grid(points, _all(points), Grid(start, np.zeros(3), larger, dims), moved[:3], index)
    moved[3:] = planes[3:, index]
    return Surfels(moved, Grid(start, origin, larger, dims))


def _sparse(surfels: Surfels, cell: float, density: Density) -> Surfels | None:
    """Surfels as a small cloud has them: as many in a cell, in cells of ``cell`` metres; None without any plane."""
    planes = surfels.planes
    chosen = np.flatnonzero(planes[3:].any(axis=0))
    chosen = chosen[:: max(1, round(len(chosen) * cell**2 / (density.points_per_cell * density.area)))]
    if len(chosen) == 0:
        return None
    points, surplus = np.ascontiguousarray(planes[:3, chosen].T), np.empty(len(chosen), bool)
    box = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    grid = _grid(points, _all(points), box, cell)
    kernels.mark_surplus(grid[2], density.most_per_cell, surplus)
    points, index, start, corner, cell, dims = _without(grid, surplus)
    return Surfels(np.concatenate([points, planes[3:, chosen[index]]]), Grid(start, surfels.grid.origin + corner, cell, dims))


def _all(points: np.ndarray) -> np.ndarray:
    return np.arange(len(points), dtype=np.int32)


def _uncrowded(points: np.ndarray, chosen: np.ndarray, box: tuple[np.ndarray, np.ndarray], density: Density):
    """The grid of the chosen points without those that crowd its cells; where these are most of them, in larger cells."""
    while True:
        grid, surplus = _grid(points, chosen, box, density.cell(len(chosen))), np.empty(len(chosen), bool)
        if 2 * kernels.mark_surplus(grid[2], density.most_per_cell, surplus) >= len(chosen):
            return _without(grid, surplus)
        chosen = np.sort(grid[1][~surplus])


def _grid(points: np.ndarray, chosen: np.ndarray, box: tuple[np.ndarray, np.ndarray], cell: float):
    """Sorted points of the chosen ones in a box, their indices, cell starts, origin, cell size and dimensions."""
    if len(chosen) == 0:
        return np.empty((3, 0), np.float32), chosen, np.zeros(10, np.int32), np.zeros(3), 1.0, np.full(3, 2, np.int64)
    lower, upper = box
    origin = lower - 1e-6
    extent = upper - origin + 1e-6
    cells = min(MAX_CELLS, CELLS_PER_POINT * len(chosen))
    cell = max(cell, 1e-4, float(np.prod(np.maximum(extent, 1e-3) / cells ** (1 / 3))) ** (1 / 3))
    dims = np.maximum((extent / cell).astype(np.int64) + 1, 1)
    while np.prod(dims.astype(float)) > 2 * cells:
        cell *= 1.3
        dims = np.maximum((extent / cell).astype(np.int64) + 1, 1)
    start = np.empty(int(np.prod(dims)) + 2, np.int32)
    sorted_points = np.empty((3, len(chosen)), np.float32)
    index = np.empty(len(chosen), np.int32)
    kernels.fill_grid(points, chosen, Grid(start, origin, cell, dims), sorted_points, index)
    return sorted_points, index, start, origin, cell, dims


def _noisy(grid, config: GridFilter) -> bool:
    """Whether the noise is about as large as the cells, so that few neighbourhoods are flat, and the cells are not crowded.

    Planes then need more points. Judged by a sample of them.
    """
    points, start, cell = grid[0], grid[2], grid[4]
    count = np.diff(start[:-1]).astype(np.float64)
    if count @ count > config.crowded * count.sum():
        return False
    stride = max(1, points.shape[1] // config.sample)
    planes = np.empty((6, -(-points.shape[1] // stride)), np.float32)
    neighbours = max(1, int(NEIGHBOURS * config.points_per_cell))
    kernels.fit_planes(points, Grid(*grid[2:]), config.plane_radius * cell, stride, neighbours, planes)
    return np.count_nonzero(planes[3:].any(axis=0)) < config.flat_share * planes.shape[1]


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
    knn_mean_distances(
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
    knn_mean_distances(points, np.arange(len(index)), Grid(*grid[2:]), others, len(start), mean)
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

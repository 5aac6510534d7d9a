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


class Box(NamedTuple):
    """A box along the axes."""

    lower: np.ndarray  # (3,) m
    upper: np.ndarray  # (3,) m


class GriddedPoints(NamedTuple):
    """M points of a frame, sorted by the cells of a grid."""

    points: np.ndarray  # (3, M) float32, relative to the grid's origin, m
    index: np.ndarray  # (M,) int32, row of each point in the frame
    grid: Grid

    @property
    def n_points(self) -> int:
        return len(self.index)


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
    match config.associate:
        case PlaneAssociation(wide_gate=gate) | NearestPoint(gate=gate):
            margin = 2.0 * gate
    box, inside = _crop(frame.points, position, margin)
    density = _density(area, config.preprocess)
    gridded = _uncrowded(frame.points, inside, box, density)
    if gridded.n_points > 0:
        match config.preprocess:
            case GridFilter():
                for _ in range(config.preprocess.doublings):
                    if not _noisy(gridded, config.preprocess):
                        break
                    density = density.doubled()
                    gridded = _uncrowded(frame.points, inside, box, density)
                gridded = _drop_sparse(gridded, config.preprocess)
            case KnnFilter():
                gridded = _drop_far(gridded, config.preprocess)
    stride = _plane_stride(gridded.n_points, len(position), config.preprocess)
    planes = _planes(gridded, stride, config.preprocess)
    sensors = _orient(planes, gridded, stride, frame.sensor_origin)
    surfels = Surfels(planes, gridded.grid) if stride == 1 else _in_larger_cells(planes, gridded.grid, stride)
    sparse = sample = None
    if isinstance(config.associate, PlaneAssociation):
        if surfels.grid.cell < gate / SPARSE_RINGS:
            sparse = _sparse(surfels, gate / SPARSE_RINGS, density)
        sample = _sample(gridded, planes, stride, samples, sensors is not None)
    start, origin, cell, dims = gridded.grid
    return Cloud(gridded.points, gridded.index, start, *surfels, origin, cell, dims, sensors, sparse, sample)


def _crop(points: np.ndarray, position: np.ndarray, margin: float) -> tuple[Box, np.ndarray]:
    """The points within ``margin`` metres of the box of (V, 3) vertices: their own box, and their rows in ``points``."""
    box, inside = Box(np.empty(3), np.empty(3)), np.empty(len(points), np.int32)
    kernels.bounds(position, margin, *box)
    return box, inside[: kernels.crop(points, *box, inside)]


def _density(area: float, config: GridFilter | KnnFilter) -> Density:
    """Of a garment with this area, square metres."""
    if isinstance(config, GridFilter):
        return Density(area, config.points_per_cell, config.widest_cell, config.least_per_cell)
    return Density(area, config.points_per_cell)


def _plane_stride(n_points: int, n_vertices: int, config: GridFilter | KnnFilter) -> int:
    """Planes are fitted at every so many-th point: a cloud denser than the garment has more than the garment can use."""
    if isinstance(config, KnnFilter):
        return 1
    return max(1, round(n_points / (config.planes_per_vertex * n_vertices)))


def _planes(gridded: GriddedPoints, stride: int, config: GridFilter | KnnFilter) -> np.ndarray:
    """(6, S) float32: planes fitted around every ``stride``-th point, their normals not oriented; see :class:`Surfels`."""
    planes = np.empty((6, -(-gridded.n_points // stride)), np.float32)
    most_neighbours = max(1, int(NEIGHBOURS * config.points_per_cell))
    radius = config.plane_radius * gridded.grid.cell
    kernels.fit_planes(gridded.points, gridded.grid, radius, stride, most_neighbours, planes)
    return planes


def _orient(planes: np.ndarray, gridded: GriddedPoints, stride: int, sensor_origin: np.ndarray | None) -> np.ndarray | None:
    """Turns the normals of planes toward their sensors, in place; the distinct sensors, (S, 3) metres, or None: not known."""
    if sensor_origin is None:
        return None
    if sensor_origin.ndim == 1:
        sensors = per_plane = sensor_origin[None, :]
    else:
        sensors, per_plane = distinct(sensor_origin), sensor_origin[gridded.index[::stride]]
    kernels.orient_normals(planes, per_plane - gridded.grid.origin)
    return sensors


def _sample(gridded: GriddedPoints, planes: np.ndarray, stride: int, most: int, oriented: bool) -> Sample | None:
    """At most so many of the points that have a surfel, spread over the grid, as they were measured; None of none."""
    count = planes.shape[1]
    if min(most, count) == 0:
        return None
    every = -(-count // most)
    point = gridded.points[:, :: stride * every].T + gridded.grid.origin
    normal = np.ascontiguousarray(planes[3:, ::every].T, np.float64)
    return Sample(np.ascontiguousarray(point), normal, oriented)  # of other layouts another kernel is compiled


def _in_larger_cells(planes: np.ndarray, grid: Grid, stride: int) -> Surfels:
    """Surfels of every ``stride``-th point, sorted into cells that hold as many of them as the points' cells do points."""
    _, origin, cell, dims = grid
    larger = cell * float(np.sqrt(stride))
    dims = (dims * cell / larger).astype(np.int64) + 1
    start, index = np.empty(int(np.prod(dims)) + 2, np.int32), np.empty(planes.shape[1], np.int32)
    points, ordered = np.ascontiguousarray(planes[:3].T), np.empty_like(planes)
    kernels.fill_grid(points, _all_rows(points), Grid(start, np.zeros(3), larger, dims), ordered[:3], index)
    ordered[3:] = planes[3:, index]
    return Surfels(ordered, Grid(start, origin, larger, dims))


def _sparse(surfels: Surfels, cell: float, density: Density) -> Surfels | None:
    """Surfels as a small cloud has them: as many in a cell, in cells of ``cell`` metres; None without any plane."""
    planes = surfels.planes
    chosen = np.flatnonzero(planes[3:].any(axis=0))
    chosen = chosen[:: max(1, round(len(chosen) * cell**2 / (density.points_per_cell * density.area)))]
    if len(chosen) == 0:
        return None
    points, surplus = np.ascontiguousarray(planes[:3, chosen].T), np.empty(len(chosen), bool)
    box = Box(points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64))
    gridded = _gridded(points, _all_rows(points), box, cell)
    kernels.mark_surplus(gridded.grid.start, density.most_per_cell, surplus)
    points, index, (start, corner, cell, dims) = _without(gridded, surplus)
    return Surfels(np.concatenate([points, planes[3:, chosen[index]]]), Grid(start, surfels.grid.origin + corner, cell, dims))


def _all_rows(points: np.ndarray) -> np.ndarray:
    return np.arange(len(points), dtype=np.int32)


def _uncrowded(points: np.ndarray, chosen: np.ndarray, box: Box, density: Density) -> GriddedPoints:
    """The grid of the chosen points without those that crowd its cells; where these are most of them, in larger cells."""
    while True:
        gridded, surplus = _gridded(points, chosen, box, density.cell(len(chosen))), np.empty(len(chosen), bool)
        if 2 * kernels.mark_surplus(gridded.grid.start, density.most_per_cell, surplus) >= len(chosen):
            return _without(gridded, surplus)
        chosen = np.sort(gridded.index[~surplus])


def _gridded(points: np.ndarray, chosen: np.ndarray, box: Box, cell: float) -> GriddedPoints:
    """The chosen rows of (N, 3) points in a box, metres, in cells of ``cell`` metres; in larger ones where these are too many."""
    if len(chosen) == 0:
        grid = Grid(np.zeros(10, np.int32), np.zeros(3), 1.0, np.full(3, 2, np.int64))
        return GriddedPoints(np.empty((3, 0), np.float32), chosen, grid)
    origin = box.lower - 1e-6
    extent = box.upper - origin + 1e-6
    most_cells = min(MAX_CELLS, CELLS_PER_POINT * len(chosen))
    cell = max(cell, 1e-4, float(np.prod(np.maximum(extent, 1e-3) / most_cells ** (1 / 3))) ** (1 / 3))
    dims = np.maximum((extent / cell).astype(np.int64) + 1, 1)
    while np.prod(dims.astype(float)) > 2 * most_cells:
        cell *= 1.3
        dims = np.maximum((extent / cell).astype(np.int64) + 1, 1)
    grid = Grid(np.empty(int(np.prod(dims)) + 2, np.int32), origin, cell, dims)
    sorted_points, index = np.empty((3, len(chosen)), np.float32), np.empty(len(chosen), np.int32)
    kernels.fill_grid(points, chosen, grid, sorted_points, index)
    return GriddedPoints(sorted_points, index, grid)


def _noisy(gridded: GriddedPoints, config: GridFilter) -> bool:
    """Whether the noise is about as large as the cells, so that few neighbourhoods are flat, and the cells are not crowded.

    Planes then need more points. Judged by a sample of them.
    """
    count = np.diff(gridded.grid.start[:-1]).astype(np.float64)
    if count @ count > config.crowded * count.sum():
        return False
    planes = _planes(gridded, max(1, gridded.n_points // config.sample), config)
    flat = np.count_nonzero(planes[3:].any(axis=0))
    return flat < config.flat_share * planes.shape[1]


def _drop_sparse(gridded: GriddedPoints, config: GridFilter) -> GriddedPoints:
    """The statistical filter, with neighbours sought for suspects alone.

    A point whose 27 cells hold a fair share of the median is an inlier. The statistics that the others are held against are of
    all points: suspects, and a sample of the rest.
    """
    suspects, rest = _suspects(gridded, config)
    if len(suspects) == 0:
        return gridded
    sample = rest[:: max(1, len(rest) // config.sample)]
    asked, distance = np.concatenate([suspects, sample]), np.empty(len(suspects) + len(sample))
    knn_mean_distances(gridded.points, asked, gridded.grid, config.neighbours - 1, config.suspect_rings, distance)
    of_suspects, of_sample = distance[: len(suspects)], distance[len(suspects) :]
    total = gridded.n_points
    if len(sample):
        mean = (of_suspects.sum() + len(rest) * of_sample.mean()) / total
        squares = np.square(of_suspects - mean).sum() + len(rest) * np.square(of_sample - mean).mean()
    else:
        mean = of_suspects.mean()
        squares = np.square(of_suspects - mean).sum()
    # a clean cloud has little spread, and its sparser parts are no outliers
    farthest = max(mean + config.ratio * np.sqrt(squares / total), config.clean_factor * mean)
    removed = np.zeros(total, bool)
    removed[suspects[of_suspects > farthest]] = True
    return _without(gridded, removed)


def _suspects(gridded: GriddedPoints, config: GridFilter) -> tuple[np.ndarray, np.ndarray]:
    """Points whose 27 cells hold few others, and the rest: their numbers in the grid's order."""
    start, dims, total = gridded.grid.start, gridded.grid.dims, gridded.n_points
    occupied, count, suspects, rest = (np.empty(total, np.int32) for _ in range(4))
    n_cells = kernels.neighbourhood_counts(start, dims, occupied, count)
    n = kernels.split_suspects(start, occupied[:n_cells], count[:n_cells], config.suspect_share, suspects, rest)
    return suspects[:n], rest[: total - n]


def _drop_far(gridded: GriddedPoints, config: KnnFilter) -> GriddedPoints:
    """Rusu and Cousins 2011, as in Open3D: mean distance to the k nearest, the point itself among them."""
    total = gridded.n_points
    if total <= 1:
        return gridded
    others, mean = min(config.neighbours, total) - 1, np.empty(total)
    every_ring = len(gridded.grid.start)  # rings are no more than cells
    knn_mean_distances(gridded.points, np.arange(total), gridded.grid, others, every_ring, mean)
    mean *= others / (others + 1)
    return _without(gridded, ~(mean < mean.mean() + config.ratio * mean.std(ddof=1)))


def _without(gridded: GriddedPoints, removed: np.ndarray) -> GriddedPoints:
    """The points without the (M,) removed ones, in the same cells."""
    left = gridded.n_points - np.count_nonzero(removed)
    if left == gridded.n_points:
        return gridded
    start, points, index = np.empty_like(gridded.grid.start), np.empty((3, left), np.float32), np.empty(left, np.int32)
    kernels.remove(gridded.grid.start, removed, gridded.points, gridded.index, start, points, index)
    return GriddedPoints(points, index, gridded.grid._replace(start=start))

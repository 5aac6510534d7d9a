"""Stage B, association (paper, section 2.3): what the cloud says about each vertex."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ddakf.config import NearestPoint, PlaneAssociation
from ddakf.garment.model import Model
from ddakf.kernels import associate as kernels
from ddakf.kernels import hem as hem_kernels
from ddakf.stages.preprocess import Cloud

HEM_WIDTH = 0.012  # m to either side: points of a cloud with 1 cm between them mark its end there
HEM_DEPTH = 0.010  # m above and below: another layer is farther away
OCCLUDER_CELL = 1.5  # edges: wide enough that the vertices of a surface leave no holes


class Hem(NamedTuple):
    """Where the cloud ends beside the H vertices of the garment's open boundaries: hems, cuffs, neck.

    A plane says nothing about the position along the surface; where the cloth ends does.
    """

    direction: np.ndarray  # (H, 3) unit, in the surface, across the boundary and outward
    offset: np.ndarray  # (H,) m, from the vertex along it to the end of the cloud
    weight: np.ndarray  # (H,) bisquare of the offset, 0 where the cloud does not end


class Measurement(NamedTuple):
    """One measurement per vertex; rows where ``found`` is false hold nothing."""

    target: np.ndarray  # (V, 3) z, m
    normal: np.ndarray | None  # (V, 3) unit normal of the cloud's surface at z; None: measured in all directions alike
    distance: np.ndarray  # (V,) m to the nearest point; negative where nothing was found
    searched_at: np.ndarray  # (V, 3) m, where the vertex was when its plane was looked for
    visible: np.ndarray | None  # (V,) bool, vertices that a sensor may see; None: not asked yet
    hem: Hem | None = None  # None: no boundary, or no cloud

    @classmethod
    def none(cls, n: int) -> Measurement:
        """Before the first pass: nothing looked for, nothing found."""
        return cls(np.zeros((n, 3)), np.zeros((n, 3)), np.full(n, -1.0), np.full((n, 3), kernels.FAR_AWAY), None)

    @property
    def found(self) -> np.ndarray:
        """(V,) bool."""
        return self.distance >= 0.0

    def innovation(self, position: np.ndarray) -> np.ndarray:
        """(V, 3) y = z - p, of a plane only its part along the normal; zero where nothing was found."""
        y = np.where(self.found[:, None], self.target - position, 0.0)
        if self.normal is None:
            return y
        return np.einsum("va,va->v", self.normal, y)[:, None] * self.normal


def gates(cloud: Cloud, config: PlaneAssociation | NearestPoint, done: int = 0) -> Iterator[float]:
    """Search radius of each pass inside the frame, metres: wide first, then narrowing. The paper makes one pass.

    Of ``done`` passes that were made already, the rest, and at least one.
    """
    match config:
        case PlaneAssociation():
            passes = 1 if cloud.empty else config.iterations
            for k in range(min(done, passes - 1), passes):
                yield max(config.narrow_gate, config.wide_gate * config.narrowing**k)
        case NearestPoint():
            yield config.gate


def associate(
    position: np.ndarray, last: Measurement, cloud: Cloud, body_vertices: np.ndarray | None, model: Model, gate: float,
    config: PlaneAssociation | NearestPoint, only: np.ndarray | None = None, visible: np.ndarray | None = None,
) -> Measurement:  # fmt: skip
    """Measurements for the vertices at ``position`` (V, 3).

    Args:
        position: metres.
        last: of the pass before; vertices that hardly moved since keep their plane.
        cloud: the preprocessed points.
        body_vertices: (B, 3) metres, what may hide the garment from a sensor, or None.
        model: the garment.
        gate: search radius, metres.
        config: plane-aligned, or the paper's nearest neighbour.
        only: (V,) bool, vertices that are measured; None: all. Hems are left out where it is given.
        visible: (V,) bool, vertices that a sensor may see, where that is known already.
    """
    n = len(position)
    match config:
        case PlaneAssociation():
            normal = np.empty((n, 3))
            target, plane, distance, searched_at = (a.copy() for a in last[:4])
            kernels.vertex_normals(position, model.faces, normal)
            if visible is None:
                visible = _visible(position, normal, cloud, body_vertices, model, config)
            eligible = visible if only is None else visible & only
            if not cloud.empty:
                beside = config.beside * float(np.sqrt(model.area / cloud.surfels.shape[1]))
                kernels.nearest_planes(
                    position, normal, eligible, cloud.surfels, cloud.surfel_start, cloud.origin, cloud.cell, cloud.dims,
                    gate, config.normal_cosine, config.turned, cloud.oriented, config.still * cloud.cell,
                    beside, searched_at, target, plane, distance,
                )  # fmt: skip
            hem = None if only is not None else _hem(position, normal, visible, cloud, model, config)
            return Measurement(target, plane, distance, searched_at, visible, hem)
        case NearestPoint():
            target, distance = np.zeros((n, 3)), np.full(n, -1.0)
            if not cloud.empty:
                kernels.nearest_points(
                    position, cloud.points, cloud.start, cloud.origin, cloud.cell, cloud.dims, gate, target, distance
                )
            return Measurement(target, None, distance, position, np.ones(n, bool))


def visible(
    position: np.ndarray, cloud: Cloud, body_vertices: np.ndarray | None, model: Model, config: PlaneAssociation
) -> np.ndarray:
    """(V,) bool: vertices at ``position`` (V, 3) that a sensor may see; arguments as of :func:`associate`."""
    normal = np.empty_like(position)
    kernels.vertex_normals(position, model.faces, normal)
    return _visible(position, normal, cloud, body_vertices, model, config)


def _visible(position, normal, cloud: Cloud, body_vertices, model: Model, config: PlaneAssociation) -> np.ndarray:
    found = np.ones(len(position), bool)
    if cloud.oriented:
        body = np.empty((0, 3)) if body_vertices is None else body_vertices
        cell = OCCLUDER_CELL * model.edge_length
        kernels.seen(
            position, normal, body, cloud.surfels, cloud.origin, cloud.sensor, cell, config.hidden_depth, config.facing_cosine,
            found,
        )  # fmt: skip
    return found


def _hem(
    position: np.ndarray, normal: np.ndarray, visible: np.ndarray, cloud: Cloud, model: Model, config: PlaneAssociation
) -> Hem | None:
    """The end of the cloud beside each vertex of a boundary at ``position`` (V, 3), its unit ``normal`` (V, 3)."""
    n = len(model.boundary)
    if cloud.empty or n == 0 or config.hem_reach == 0:
        return None
    direction, offset, found = np.zeros((n, 3)), np.zeros(n), np.zeros(n, bool)
    hem_kernels.ends_of_cloud(
        position, normal, visible, model.boundary, cloud.points, cloud.start, cloud.origin, cloud.cell, cloud.dims,
        config.hem_reach, HEM_WIDTH, HEM_DEPTH, direction, offset, found,
    )  # fmt: skip
    return Hem(direction, offset, found * np.square(np.maximum(1.0 - np.square(offset / config.hem_reach), 0.0)))

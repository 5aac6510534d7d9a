"""Working mesh: the even mesh whose vertices are tracked, and the template that it carries along."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ddakf.config import Discretisation
from ddakf.garment import remeshing
from ddakf.kernels import working_mesh as kernels
from ddakf.mesh import Mesh
from ddakf.results import FrameResult
from ddakf.types import variances

SHORTEST = 1e-6  # m: the square of less may be 0


class Places(NamedTuple):
    """The place of the W vertices of a working mesh and the V vertices of a template on each other's faces."""

    on_template: tuple[np.ndarray, np.ndarray]  # (W, 3) int32 corners in [0, V) and (W, 3) barycentric coordinates
    on_mesh: tuple[np.ndarray, np.ndarray]  # (V, 3) int32 corners in [0, W) and (V, 3) barycentric coordinates


class WorkingMesh(NamedTuple):
    """The mesh of W vertices that is tracked, and the template of V vertices that it carries along."""

    template: Mesh
    mesh: Mesh
    places: Places | None  # None: the template is its own working mesh

    def sampled(self, values: np.ndarray) -> np.ndarray:
        """(W, 3) values at the working vertices, of (V, 3) values of the template."""
        return values if self.places is None else interpolated(values, *self.places.on_template)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """(V, ...) values at the template's vertices, of (W, ...) values of the working mesh."""
        return values if self.places is None else interpolated(values, *self.places.on_mesh)

    def carried(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """(V, 3) metres, the template's vertices, each fixed to the local frames of its face's corners.

        Args:
            position: (W, 3) metres.
            rotation: (W, 3, 3) of the working mesh's one-rings against the rest shape.
        """
        if self.places is None:
            return position
        carried, (corner, share) = np.empty_like(self.template.vertices), self.places.on_mesh
        kernels.carry(self.mesh.vertices, position, rotation, self.template.vertices, corner, share, carried)
        return carried

    def result(self, result: FrameResult, rotation: np.ndarray) -> FrameResult:
        """The result at the template's vertices, of one at the working vertices.

        The errors of neighbours are taken as equal, so that the covariance between them is their mean.

        Args:
            result: arrays of W rows.
            rotation: (W, 3, 3) of the working mesh's one-rings against the rest shape.
        """
        if self.places is None:
            return result
        covariance = self.spread(result.covariance)
        return replace(
            result,
            vertices=self.carried(result.vertices, rotation),
            velocities=self.spread(result.velocities),
            covariance=covariance,
            sigma=np.sqrt(variances(covariance)),
            vertex_reliability=self.spread(result.vertex_reliability),
            observed=self.spread(result.observed.astype(np.float64)) > 0.5,
        )


def build(template: Mesh, config: Discretisation) -> WorkingMesh:
    """The working mesh of a template, which is its own where it is even and not finer than needed.

    Args:
        template: the garment at rest.
        config: lengths of edges and numbers of vertices.
    """
    own = WorkingMesh(template, template, None)
    if config.working_edge == 0.0:
        return own
    edge = working_edge(template, config)
    if template.edge_length > config.working_finest * edge and unevenness(template) < config.working_unevenness:
        return own
    even = remeshing.remesh(template, edge)
    if even is None:
        return own
    return WorkingMesh(template, even.mesh, Places((even.corner, even.share), _on_mesh(template, even)))


def working_edge(template: Mesh, config: Discretisation) -> float:
    """Metres: the configured edge, shorter for a small garment and longer for a large one, by the bounds of the vertices."""
    edge = max(config.working_edge, SHORTEST)
    per_vertex = 0.5 * math.sqrt(3.0) * edge**2  # area, in a mesh of equilateral triangles
    area = float(remeshing.areas(template).sum())
    count = min(max(area / per_vertex, config.working_vertices_least), config.working_vertices_most)
    return edge * math.sqrt(area / per_vertex / count)


def unevenness(mesh: Mesh) -> float:
    """Standard deviation of the logarithms of the areas of the vertices off the boundary; 0 where there are none."""
    area = np.bincount(mesh.faces.ravel(), np.repeat(remeshing.areas(mesh), 3), mesh.n_vertices)[~mesh.boundary_vertices]
    return float(np.log(area).std()) if len(area) else 0.0


def interpolated(values: np.ndarray, corner: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(N, ...) sums of the values (n, ...) at (N, 3) corners, weighted by (N, 3) shares."""
    result = np.empty((len(corner), *values.shape[1:]))
    rows = np.ascontiguousarray(values, np.float64).reshape(len(values), -1)
    kernels.spread(rows, corner, share, result.reshape(len(corner), -1))
    return result


def _on_mesh(template: Mesh, even: remeshing.Remeshed) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) corners and barycentric coordinates of the point of the working mesh that is closest to each vertex."""
    mesh, n = even.mesh, template.n_vertices
    corner, share = np.empty((n, 3), np.int32), np.empty((n, 3))
    start, around = _faces_around(mesh)
    kernels.find_corners(template.vertices, mesh.vertices, mesh.faces, start, around, even.owner, corner, share)
    return corner, share


def _faces_around(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Faces around each vertex in compressed rows: (V + 1,) starts, and (3F,) faces."""
    start = np.zeros(mesh.n_vertices + 1, np.int64)
    start[1:] = np.cumsum(np.bincount(mesh.faces.ravel(), minlength=mesh.n_vertices))
    return start, np.argsort(mesh.faces.ravel(), kind="stable") // 3

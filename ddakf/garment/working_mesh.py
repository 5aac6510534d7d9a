"""Working mesh: the even mesh whose vertices are tracked, and the template that it carries along.

Small pieces that nothing joins to the garment, such as buttons, are carried along: on their own too few points would hold them.
So is the inner layer of a garment with a thickness.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ddakf.config import Discretisation
from ddakf.garment import geodesic, remeshing, thickness
from ddakf.kernels import working_mesh as kernels
from ddakf.mesh import Mesh
from ddakf.results import FrameResult
from ddakf.types import variances

SHORTEST = 1e-6  # m: the square of less may be 0
SLIVER = 0.01  # mean edges; a template with a shorter edge is not even: its forces would be too stiff
LONGEST = 2.4  # longest edges over heights; a template whose median triangle is longer is not even
SMALL = 0.05  # share of the surface below which a piece is carried along
COARSER = 1.2  # edges over those that the configuration asks for, from which on it is not as fine as asked
ALL_SMALL = 0.25  # share of all small pieces from which on they are the garment


class Places(NamedTuple):
    """The place of the W vertices of a working mesh and the V vertices of a template on each other's faces."""

    on_template: tuple[np.ndarray, np.ndarray]  # (W, 3) int32 corners in [0, V) and (W, 3) barycentric coordinates
    on_mesh: tuple[np.ndarray, np.ndarray]  # (V, 3) int32 corners in [0, W) and (V, 3) barycentric coordinates


class WorkingMesh(NamedTuple):
    """The mesh of W vertices that is tracked, and the template of V vertices that it carries along."""

    template: Mesh
    mesh: Mesh
    places: Places | None  # None: the template is its own working mesh
    doubt: str = ""  # a sentence where this is no good mesh to track, or not the one that the configuration asks for

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
    """The working mesh of a template: its own where that is even, of one layer, in large pieces, and neither too fine nor coarse.

    Args:
        template: the garment at rest.
        config: lengths of edges and numbers of vertices.
    """
    if config.working_edge == 0.0:
        return WorkingMesh(template, template, None)
    kept = _of_cloth(template)
    cloth = template if kept.all() else _part(template, kept)
    edge, even, doubt = working_edge(cloth, config), None, ""
    longest = config.working_coarsest * max(edge, config.working_edge)
    if not (cloth.edge_length > config.working_finest * edge and unevenness(cloth) < config.working_unevenness):
        even = remeshing.remesh(cloth, edge)
        doubt = "" if even is not None else _kept_as_it_is(cloth, edge)
    elif cloth.edge_length > longest:
        even = _split(cloth, longest)
    doubt = doubt or _not_as_fine_as_asked(cloth, even, config)
    if even is None:
        if cloth is template:
            return WorkingMesh(template, template, None, doubt)
        even = _itself(cloth)
    owner = np.empty(template.n_vertices, even.owner.dtype)
    owner[kept] = even.owner
    owner[~kept] = geodesic.nearest_points(even.mesh.vertices, template.vertices[~kept])
    on_mesh = _on_mesh(template, even._replace(owner=owner))
    places = Places((np.flatnonzero(kept)[even.corner].astype(np.int32), even.share), on_mesh)
    return WorkingMesh(template, even.mesh, places, doubt)


def working_edge(template: Mesh, config: Discretisation) -> float:
    """Metres: the configured edge, shorter for a small garment and longer for a large one, by the bounds of the vertices."""
    edge = max(config.working_edge, SHORTEST)
    per_vertex = 0.5 * math.sqrt(3.0) * edge**2  # area, in a mesh of equilateral triangles
    area = float(remeshing.areas(template).sum())
    count = min(max(area / per_vertex, config.working_vertices_least), config.working_vertices_most)
    return edge * math.sqrt(area / per_vertex / count)


def unevenness(mesh: Mesh) -> float:
    """Standard deviation of the logarithms of the areas of the vertices off the boundary; 0 where there are none.

    Infinite where an edge is shorter than ``SLIVER`` mean ones, or the triangles are longer than ``LONGEST`` times their height
    in the median: along their short edges cloth would slide.
    """
    ends = mesh.vertices[mesh.edges]
    if np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).min() < SLIVER * mesh.edge_length or elongation(mesh) > LONGEST:
        return math.inf
    area = np.bincount(mesh.faces.ravel(), np.repeat(remeshing.areas(mesh), 3), mesh.n_vertices)[~mesh.boundary_vertices]
    return float(np.log(area).std()) if len(area) else 0.0


def elongation(mesh: Mesh) -> float:
    """Median over the triangles of the longest edge over the height on it; 1.15 where they are equilateral."""
    corners = mesh.vertices[mesh.faces]
    longest2 = np.square(corners - np.roll(corners, 1, axis=1)).sum(axis=2).max(axis=1)
    return float(np.median(longest2 / np.maximum(2.0 * remeshing.areas(mesh), SHORTEST**2)))


def interpolated(values: np.ndarray, corner: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(N, ...) sums of the values (n, ...) at (N, 3) corners, weighted by (N, 3) shares."""
    result = np.empty((len(corner), *values.shape[1:]))
    rows = np.ascontiguousarray(values, np.float64).reshape(len(values), -1)
    kernels.spread(rows, corner, share, result.reshape(len(corner), -1))
    return result


def _kept_as_it_is(mesh: Mesh, edge: float) -> str:
    """The sentence about a mesh that an even one of these edges, metres, should replace, and none keeps its surface."""
    tracked = f"tracked as it is, with its {mesh.n_vertices} vertices"
    if (long := elongation(mesh)) > LONGEST:
        triangles = f"triangles at most {LONGEST:g} times as long as high, got {long:.3g} times in the median"
        return f"template: expected {triangles}: it is {tracked}, and cloth slides along their short edges; split the long ones"
    holes, parts = len(remeshing.boundary_loops(mesh)), int(geodesic.pieces(mesh.edges, mesh.n_vertices).max()) + 1
    handles = parts - (mesh.n_vertices - len(mesh.edges) + mesh.n_faces + holes) // 2  # Euler's formula
    shape = f"no even mesh of {1e3 * edge:.0f} mm edges keeps its {holes} openings and {handles} handles"
    return f"template: {shape}: it is {tracked}, more slowly and less well; close small holes, and remove loops"


def _not_as_fine_as_asked(cloth: Mesh, even: remeshing.Remeshed | None, config: Discretisation) -> str:
    """The sentence about edges that are longer than a configuration asks for which is finer than the default."""
    asked, got = config.working_edge, (cloth if even is None else even.mesh).edge_length
    if asked >= Discretisation().working_edge or got <= COARSER * asked:
        return ""
    why = "those of an even template, of which only long ones are split"
    if even is not None:
        why = f"of {even.mesh.n_vertices} vertices; working_vertices_most is {config.working_vertices_most}"
    return f"discretisation.working_edge: expected edges of {1e3 * asked:.3g} mm, got {1e3 * got:.3g} mm: {why}"


def _of_cloth(template: Mesh) -> np.ndarray:
    """(V,) bool, of the vertices of the faces that are tracked: neither of the inner layer nor in small pieces."""
    left_out = _in_small_pieces(template) | thickness.inner_layer(template)
    kept = np.zeros(template.n_vertices, bool)
    kept[template.faces[~left_out[template.faces].any(axis=1)]] = True
    return kept


def _in_small_pieces(mesh: Mesh) -> np.ndarray:
    """(V,) bool, of the vertices of pieces with less than ``SMALL`` of the surface, unless the garment consists of such."""
    piece = geodesic.pieces(mesh.edges, mesh.n_vertices)
    area = np.bincount(piece[mesh.faces[:, 0]], remeshing.areas(mesh), piece.max() + 1)
    small = area < SMALL * area.sum()
    return (small & (area[small].sum() < ALL_SMALL * area.sum()))[piece]


def _part(mesh: Mesh, kept: np.ndarray) -> Mesh:
    """The mesh of some vertices alone, (V,) bool, and of the faces whose corners are all of them."""
    number = np.cumsum(kept) - 1
    return Mesh(mesh.vertices[kept], number[mesh.faces[kept[mesh.faces].all(axis=1)]])


def _split(mesh: Mesh, longest: float) -> remeshing.Remeshed | None:
    """The mesh with edges of at most ``longest`` metres, so that its large triangles may bend; None for needles."""
    if (found := remeshing.subdivided(mesh, longest)) is None:
        return None
    fine, place = found
    return remeshing.Remeshed(fine, place.corner, place.share, np.arange(mesh.n_vertices))


def _itself(mesh: Mesh) -> remeshing.Remeshed:
    """A mesh as its own even one."""
    every = np.arange(mesh.n_vertices)
    return remeshing.Remeshed(mesh, np.repeat(every[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(every), 1)), every)


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

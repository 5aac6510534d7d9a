"""Model of a garment: topology, rest shape, subdivision, and the constants of its energies."""

from __future__ import annotations

import numpy as np

from ddakf.config import Config, Discretisation
from ddakf.garment import clusters, geodesic
from ddakf.kernels.surface_points import FaceRings
from ddakf.mesh import Mesh
from ddakf.physics import bend, collision, self_collision, shear, strain, stretch
from ddakf.types import Model

TOP = 0.03  # m: as far below a garment's highest vertex reach waistbands and collars, by which it hangs

CURVE_BITS = 20  # per axis: a million cells


def build(mesh: Mesh, config: Config | None = None) -> Model:
    """Model of a garment.

    Args:
        mesh: the garment at rest.
        config: subdivision, distance from the body and bending; ``Config()`` if None.
    """
    config = Config() if config is None else config
    pieces = config.discretisation
    ends = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    edges = ends[order]
    start = np.searchsorted(edges[:, 0], np.arange(mesh.n_vertices + 1))
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    vertex_area = np.bincount(mesh.faces.ravel(), np.repeat(area, 3), mesh.n_vertices)
    graph = geodesic.graph_of(mesh.edges, np.linalg.norm(np.subtract(*mesh.vertices[mesh.edges.T]), axis=1), mesh.n_vertices)
    distance = _distances(graph, mesh, pieces)
    cluster = distance.argmin(axis=0).astype(np.int32)
    patch = distance[: pieces.patches].argmin(axis=0).astype(np.int32)
    aggregates = min(pieces.aggregates, max(1, mesh.n_vertices // pieces.aggregate_vertices))
    aggregate = distance[:aggregates].argmin(axis=0).astype(np.int32)
    contact = collision.build(mesh, config.physics.thickness)
    rest_edge, boundary = mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]], _boundary(mesh)
    return Model(
        mesh=mesh,
        faces=mesh.faces.astype(np.int32),
        rings=_rings(mesh),
        start=start.astype(np.uint32),
        neighbour=np.ascontiguousarray(edges[:, 1], np.uint32),
        edge=(order % len(mesh.edges)).astype(np.uint32),
        cluster=cluster,
        n_clusters=int(cluster.max()) + 1,
        aggregate=aggregate,
        n_aggregates=int(aggregate.max()) + 1,
        patch=patch,
        likeness=_likeness(mesh.vertices, patch, pieces.correlation_length),
        clusters=clusters.build(mesh, distance, edges, pieces),
        rest_edge=rest_edge.astype(np.float32),
        rest_length=np.linalg.norm(rest_edge, axis=1).astype(np.float32),
        crossing=crossings(edges, patch),
        boundary=boundary,
        inside=_inside(graph, boundary[:, 0], config.segmentation.boundary_distance),
        hanging=_hanging(graph, mesh.vertices @ config.start.to_y_up[1]),
        curve=_curve(mesh.vertices, mesh.edge_length),
        area=float(area.sum()),
        vertex_share=(vertex_area / vertex_area.mean()).astype(np.float32),
        edge_length=mesh.edge_length,
        stretch=stretch.build(mesh),
        shear=shear.build(mesh),
        strain=strain.build(mesh),
        bend=bend.build(mesh, config.physics.bend_height),
        collision=contact,
        layers=self_collision.build(mesh, contact.weight, contact.thickness, config.physics),
    )


def _rings(mesh: Mesh) -> FaceRings:
    """The faces with their edges, and those around each vertex."""
    faces, n = mesh.faces, mesh.n_vertices
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    edge = np.searchsorted(mesh.edges @ [n, 1], ends @ [n, 1])
    start = np.concatenate([[0], np.cumsum(np.bincount(faces.ravel(), minlength=n))])
    around = np.argsort(faces.ravel(), kind="stable") // 3
    return FaceRings(*(a.astype(np.int32) for a in (faces, edge, start, around)))


def crossings(edges: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """(C, 3) int32: each of the (2E, 2) one-ring entries that joins two patches, and the two patches."""
    entry = np.flatnonzero(patch[edges[:, 0]] != patch[edges[:, 1]])
    return np.column_stack([entry, patch[edges[entry]]]).astype(np.int32)


def _distances(graph: geodesic.Graph, mesh: Mesh, config: Discretisation) -> np.ndarray:
    """(K, V) along the surface from each of K seeds, metres.

    The first seed is the vertex farthest from the middle, each later one the vertex farthest from the seeds before it. In a
    garment of one piece the numbering of the vertices has no influence.
    """
    n = mesh.n_vertices
    away = np.square(mesh.vertices - mesh.vertices.mean(axis=0)).sum(axis=1)
    distance = np.empty((min(config.clusters, max(1, n // config.cluster_vertices)), n))
    nearest = np.full(n, np.inf)
    for k in range(len(distance)):
        distance[k], _ = geodesic.distances(graph, [int(np.argmax(nearest if k else away))])
        np.minimum(nearest, distance[k], out=nearest)
    return distance


def _hanging(graph: geodesic.Graph, height: np.ndarray) -> np.ndarray:
    """(V,) float32 metres along the surface from the garment's top; in a piece without it, the height below it."""
    below = height.max() - height
    distance, _ = geodesic.distances(graph, np.flatnonzero(below <= TOP))
    return np.where(np.isfinite(distance), distance, below).astype(np.float32)


def _curve(vertices: np.ndarray, cell: float) -> np.ndarray:
    """(V,) int32: the (V, 3) vertices along a Z-order curve through cells of so many metres (Morton 1966, "A computer oriented
    geodetic data base"). Its parts are compact, so that each has its share of a sample, however the vertices are numbered."""
    place = ((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    code = np.zeros(len(vertices), np.int64)
    for bit in range(CURVE_BITS):
        code |= (place >> bit & 1) @ [1, 2, 4] << 3 * bit
    return np.argsort(code, kind="stable").astype(np.int32)


def _boundary(mesh: Mesh) -> np.ndarray:
    """(H, 3) vertices of open boundaries, each with the one before and the one after it in its faces' direction."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    forward, backward = edges @ [mesh.n_vertices, 1], edges @ [1, mesh.n_vertices]
    backward.sort()
    at = np.minimum(np.searchsorted(backward, forward), len(backward) - 1)
    edges = edges[backward[at] != forward]
    after, before = np.full(mesh.n_vertices, -1), np.full(mesh.n_vertices, -1)
    after[edges[:, 0]], before[edges[:, 1]] = edges[:, 1], edges[:, 0]
    vertex = np.flatnonzero((after >= 0) & (before >= 0))
    return np.stack([vertex, before[vertex], after[vertex]], axis=1).astype(np.int32)


def _inside(graph: geodesic.Graph, boundary: np.ndarray, least: float) -> np.ndarray:
    """(V,) int32: the nearest vertex that is ``least`` metres or more from these along the surface; without one, itself."""
    away, _ = geodesic.distances(graph, boundary)
    inner = np.flatnonzero(away >= least)
    _, owner = geodesic.distances(graph, inner)
    return np.where(owner >= 0, np.append(inner, 0)[owner], np.arange(len(away))).astype(np.int32)


def _likeness(vertices: np.ndarray, patch: np.ndarray, length: float) -> np.ndarray:
    """(L, L) float32 correlation of the motion of patches, of a correlation length in metres."""
    size = np.bincount(patch)
    centre = np.column_stack([np.bincount(patch, vertices[:, a]) for a in range(3)]) / size[:, None]
    squared = np.square(centre[:, None] - centre[None]).sum(axis=2)
    return np.exp(-0.5 * squared / length**2).astype(np.float32)

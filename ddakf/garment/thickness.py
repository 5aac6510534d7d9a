"""Garments with a thickness, of an outer and an inner layer of faces, as programs that draw garments export them.

A camera sees the outer layer alone, and both would share its points.
"""

from __future__ import annotations

import numpy as np

from ddakf.body import proximity
from ddakf.garment import geodesic, remeshing
from ddakf.mesh import Mesh

THICKEST = 0.01  # m, half of the largest distance between the layers
AGAINST = -0.8  # cosine between the normals of faces of both layers, at most
PAIRED = 0.7  # least share of the surface that has another layer beneath
SAMPLE = 1000  # faces that are looked at first
FLAT = 0.5  # |mean normal| from which on a piece goes around nothing: of two flat ones neither is the inner one


def inner_layer(mesh: Mesh) -> np.ndarray:
    """(V,) bool, of the vertices of the inner layer of a garment with a thickness; none where there is one layer.

    It lies behind another one, with opposite normals, and has less area. Two layers are a thickness where the mesh is closed but
    for pinholes, or where they are two pieces that go around something: front and back of a shirt that lies flat are open at its
    hems, or flat.
    """
    none = np.zeros(mesh.n_vertices, bool)
    piece = geodesic.pieces(mesh.edges, mesh.n_vertices)
    closed = not remeshing.openings(mesh)
    if not closed and piece.max() == 0:
        return none
    normal, area = _normals_and_areas(mesh)
    body, every = proximity.build(mesh), np.arange(mesh.n_faces)
    some = every[:: mesh.n_faces // SAMPLE + 1]
    if area[some[_faces_behind(mesh, body, normal, some) >= 0]].sum() < 0.5 * PAIRED * area[some].sum():
        return none
    behind = _faces_behind(mesh, body, normal, every)
    paired = behind >= 0
    if not closed:
        paired &= piece[mesh.faces[behind, 0]] != piece[mesh.faces[:, 0]]
    if area[paired].sum() < PAIRED * area.sum():
        return none
    at_rim = np.zeros(mesh.n_vertices, bool)
    at_rim[mesh.faces[~paired]] = True
    paired &= ~at_rim[mesh.faces].any(axis=1)  # some faces of a rim have a layer behind them by chance, and join both
    if not paired.any():
        return none
    part = _parts(mesh.faces, paired, mesh.n_vertices)
    is_inner = _is_inner(part[paired], part[behind[paired]], (normal * area[:, None])[paired], closed)
    inner = paired.copy()
    inner[paired] = is_inner[part[paired]]
    if not inner.any():
        return none
    return _grown(mesh, paired & ~inner, inner)


def _normals_and_areas(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) unit normals and (F,) square metres."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    doubled = np.cross(b - a, c - a)
    length = np.linalg.norm(doubled, axis=1)
    return doubled / np.maximum(length, np.finfo(float).tiny)[:, None], 0.5 * length


def _faces_behind(mesh: Mesh, body: proximity.Body, normal: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """(N,) the face of the other layer behind each of the chosen faces, (N,), or -1; ``body`` is the search tree of the mesh.

    From the point that is ``THICKEST`` behind a face any other layer in between is nearer than the face itself.
    """
    points = mesh.vertices[mesh.faces[chosen]].mean(axis=1) - THICKEST * normal[chosen]
    found = proximity.closest_points(body, proximity.refresh(body, mesh.vertices), points, THICKEST).face
    behind = np.where(found >= 0, body.original_face[found], -1)
    against = np.einsum("ni,ni->n", normal[chosen], normal[behind]) < AGAINST
    return np.where(against, behind, -1)


def _parts(faces: np.ndarray, chosen: np.ndarray, n_vertices: int) -> np.ndarray:
    """(F,) number of the part of the chosen faces (bool) that each is of; of others, of the part at its first corner."""
    own = faces[chosen]
    return geodesic.pieces(np.concatenate([own[:, [0, 1]], own[:, [1, 2]]]), n_vertices)[faces[:, 0]]


def _is_inner(part: np.ndarray, behind: np.ndarray, areas: np.ndarray, closed: bool) -> np.ndarray:
    """By part: whether it has less area than the part that most of it lies before.

    Args:
        part: (N,) of each paired face.
        behind: (N,) part of the face behind it.
        areas: (N, 3) m^2, along the normals.
        closed: whether the mesh is.
    """
    n, area = int(max(part.max(), behind.max())) + 1, np.linalg.norm(areas, axis=1)
    size = np.bincount(part, area, n)
    pairs, number = np.unique(part * n + behind, return_inverse=True)
    shared = np.bincount(number, area)
    order = np.argsort(shared, kind="stable")
    other = np.arange(n)
    other[pairs[order] // n] = pairs[order] % n
    vector = np.stack([np.bincount(part, areas[:, k], n) for k in range(3)], axis=1)
    around = np.linalg.norm(vector, axis=1) < FLAT * size
    first = np.arange(n) < other
    less = np.where(size == size[other], ~first, size < size[other])
    return less & (other != np.arange(n)) & (around | closed)


def _grown(mesh: Mesh, outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """(V,) bool, of the vertices that are nearer, along the surface, to ``inner`` faces (bool) than to ``outer`` ones."""
    ends = mesh.vertices[mesh.edges]
    graph = geodesic.graph_of(mesh.edges, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), mesh.n_vertices)
    of_outer, of_inner = (np.unique(mesh.faces[chosen]) for chosen in (outer, inner))
    return geodesic.distances(graph, of_inner)[0] < geodesic.distances(graph, of_outer)[0]

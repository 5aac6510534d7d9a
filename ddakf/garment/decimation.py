"""Decimation: a mesh on some vertices of a garment, and the position of the other vertices on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ddakf.errors import InvalidMesh
from ddakf.kernels import pyramid as kernels
from ddakf.mesh import Mesh


class Decimated(NamedTuple):
    """A mesh on W of the V vertices of another."""

    mesh: Mesh
    vertex: np.ndarray  # (W,) in [0, V)
    corner: np.ndarray  # (V, 3) int32 in [0, W): the face on which each vertex lies
    share: np.ndarray  # (V, 3) its barycentric coordinates there


def decimate(mesh: Mesh, graph: csr_array, away: np.ndarray, least: int) -> Decimated | None:
    """A mesh of about a quarter of the vertices, joined where their geodesic Voronoi regions meet.

    The vertices are an independent set, chosen along the boundaries first, so that boundaries keep their place. In a
    garment of one piece the numbering of the vertices has no influence.

    Args:
        mesh: of V vertices.
        graph: (V, V) lengths of its edges, metres.
        away: (V,) distances from one of its vertices, metres: the order in which vertices are chosen.
        least: vertices below which there is no such mesh; None is returned then.
    """
    chosen = np.empty(mesh.n_vertices, bool)
    kernels.choose_independent(np.lexsort((away, ~mesh.boundary_vertices)), graph.indptr, graph.indices, chosen)
    seeds = np.flatnonzero(chosen)
    owner = _owners(mesh, graph, seeds)[mesh.faces]
    faces = owner[(owner != np.roll(owner, 1, axis=1)).all(axis=1)]
    if len(faces) == 0:
        return None
    try:
        smaller, used = Mesh.cleaned(mesh.vertices[seeds], faces)
    except InvalidMesh:  # cleaning a mesh of specks leaves no face
        return None
    if smaller.n_vertices < least:
        return None
    vertex = seeds[used]
    corner, share = np.empty((mesh.n_vertices, 3), np.int32), np.empty((mesh.n_vertices, 3))
    start = np.zeros(len(vertex) + 1, np.int64)
    start[1:] = np.cumsum(np.bincount(smaller.faces.ravel(), minlength=len(vertex)))
    around = np.argsort(smaller.faces.ravel(), kind="stable") // 3
    owner = _owners(mesh, graph, vertex)
    kernels.find_corners(mesh.vertices, smaller.vertices, smaller.faces, start, around, owner, corner, share)
    return Decimated(smaller, vertex, corner, share)


def _owners(mesh: Mesh, graph: csr_array, seeds: np.ndarray) -> np.ndarray:
    """(V,) number of the seed that is nearest along the surface, or through the air in a piece without a seed."""
    distance, _, source = dijkstra(graph, indices=seeds, min_only=True, return_predecessors=True)
    number = np.zeros(mesh.n_vertices, np.int64)
    number[seeds] = np.arange(len(seeds))
    apart = ~np.isfinite(distance)
    owner = number[np.where(apart, seeds[0], source)]
    if apart.any():
        owner[apart] = cKDTree(mesh.vertices[seeds]).query(mesh.vertices[apart])[1]
    return owner

"""A coarser mesh on some of the vertices of a garment, and where the others lie on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ddakf.errors import InvalidMesh
from ddakf.kernels import pyramid as kernels
from ddakf.mesh import Mesh

LEAST = 250  # vertices of a coarser mesh


class Thinned(NamedTuple):
    """A mesh of W of the V vertices of another."""

    mesh: Mesh
    vertex: np.ndarray  # (W,) in [0, V)
    corner: np.ndarray  # (V, 3) int32 in [0, W): the face on which each vertex lies
    share: np.ndarray  # (V, 3) its barycentric coordinates there


def thin(mesh: Mesh, graph: csr_array, away: np.ndarray) -> Thinned | None:
    """About a quarter of the vertices, joined where their geodesic Voronoi regions meet; None where those are too few.

    The vertices are an independent set, chosen along the boundaries first, so that these stay where they are. In a
    garment of one piece their numbering does not matter.

    Args:
        mesh: of V vertices.
        graph: (V, V) lengths of its edges, metres.
        away: (V,) distances from one of its vertices, metres: the order in which vertices are chosen.
    """
    chosen = np.empty(mesh.n_vertices, bool)
    kernels.choose_independent(np.lexsort((away, ~mesh.boundary_vertices)), graph.indptr, graph.indices, chosen)
    seeds = np.flatnonzero(chosen)
    owner = _owners(mesh, graph, seeds)[mesh.faces]
    faces = owner[(owner != np.roll(owner, 1, axis=1)).all(axis=1)]
    if len(faces) == 0:
        return None
    try:
        coarse, kept = Mesh.cleaned(mesh.vertices[seeds], faces)
    except InvalidMesh:  # nothing is left of a mesh of specks
        return None
    if coarse.n_vertices < LEAST:
        return None
    vertex = seeds[kept]
    corner, share = np.empty((mesh.n_vertices, 3), np.int32), np.empty((mesh.n_vertices, 3))
    start = np.zeros(len(vertex) + 1, np.int64)
    start[1:] = np.cumsum(np.bincount(coarse.faces.ravel(), minlength=len(vertex)))
    around = np.argsort(coarse.faces.ravel(), kind="stable") // 3
    owner = _owners(mesh, graph, vertex)
    kernels.find_corners(mesh.vertices, coarse.vertices, coarse.faces, start, around, owner, corner, share)
    return Thinned(coarse, vertex, corner, share)


def _owners(mesh: Mesh, graph: csr_array, seeds: np.ndarray) -> np.ndarray:
    """(V,) number of the seed that is nearest along the surface; through the air, in a piece without one."""
    distance, _, source = dijkstra(graph, indices=seeds, min_only=True, return_predecessors=True)
    number = np.zeros(mesh.n_vertices, np.int64)
    number[seeds] = np.arange(len(seeds))
    apart = ~np.isfinite(distance)
    owner = number[np.where(apart, seeds[0], source)]
    if apart.any():
        owner[apart] = cKDTree(mesh.vertices[seeds]).query(mesh.vertices[apart])[1]
    return owner

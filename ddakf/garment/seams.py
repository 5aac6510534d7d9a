"""Parts of a garment that are not joined where they should be, such as a sleeve beside its armhole."""

from __future__ import annotations

import numpy as np

from ddakf.garment import geodesic
from ddakf.mesh import Mesh

LEAST = 8  # vertices around an opening, or of a seam
BESIDE = 0.9  # share of an opening that is near another part
CLOSE = 0.25  # mean edges: vertices that are nearer to another part are at a seam, whatever their share of the opening


def gap(mesh: Mesh) -> float:
    """Metres between an opening of one piece and the boundaries of other pieces, if they run beside each other; else 0.

    Nearly all of the opening has to be within a mean edge of them, or a part of it very near, as the side of a panel. The mean
    distance counts.
    """
    boundary = np.flatnonzero(mesh.boundary_vertices)
    piece = geodesic.pieces(mesh.edges, mesh.n_vertices)[boundary]
    if len(boundary) == 0 or np.ptp(piece) == 0:
        return 0.0
    place, opening, near = mesh.vertices[boundary], _openings(mesh)[boundary], np.empty(len(boundary))
    for number in np.unique(piece):
        mine = piece == number
        others = place[~mine]
        near[mine] = np.linalg.norm(place[mine] - others[geodesic.nearest_points(others, place[mine])], axis=1)
    size, beside = np.bincount(opening), np.bincount(opening, near < mesh.edge_length)
    apart = ((size >= LEAST) & (beside >= BESIDE * size))[opening]
    close = near < CLOSE * mesh.edge_length
    apart |= close & (np.bincount(piece, close)[piece] >= LEAST)
    return float(near[apart].mean()) if apart.any() else 0.0


def _openings(mesh: Mesh) -> np.ndarray:
    """(V,) number of the opening that each boundary vertex is at."""
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    return geodesic.pieces(edges[count == 1], mesh.n_vertices)

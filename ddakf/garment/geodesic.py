"""Geodesic distance along the edges of a garment, and nearest points through the air."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.kernels import geodesic as kernels


class Graph(NamedTuple):
    """The one-rings of V vertices in compressed rows, with the lengths of their edges."""

    start: np.ndarray  # (V + 1,) int64
    neighbour: np.ndarray  # (2E,) int32
    length: np.ndarray  # (2E,) m, or a multiple of the wanted edge

    def between(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(N,) lengths of the edges that join vertices a and b, (N,) each."""
        n = len(self.start) - 1
        entry = np.repeat(np.arange(n), np.diff(self.start)) * n + self.neighbour
        return self.length[np.searchsorted(entry, np.asarray(a, np.int64) * n + b)]

    def pieces(self) -> int:
        """Number of pieces that edges join."""
        return int(self.piece_of_vertices().max(initial=-1)) + 1

    def piece_of_vertices(self) -> np.ndarray:
        """(V,) number, from 0 on, of the piece that each vertex is of."""
        piece = np.empty(len(self.start) - 1, np.int64)
        kernels.number_pieces(self.start, self.neighbour, piece)
        return piece


def graph_of(edges: np.ndarray, length: np.ndarray, n_vertices: int) -> Graph:
    """The graph of edges (E, 2) with lengths (E,)."""
    ends, lengths = np.concatenate([edges, edges[:, ::-1]]), np.concatenate([length, length])
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    start = np.searchsorted(ends[order, 0], np.arange(n_vertices + 1)).astype(np.int64)
    return Graph(start, np.ascontiguousarray(ends[order, 1], np.int32), lengths[order])


def pieces(edges: np.ndarray, n_vertices: int) -> np.ndarray:
    """(V,) number, from 0 on, of the piece that each vertex is of, by edges (E, 2)."""
    return graph_of(edges, np.ones(len(edges)), n_vertices).piece_of_vertices()


def distances(graph: Graph, seeds: np.ndarray, begun: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(V,) distance from the nearest seed in metres, infinite in a piece without one, and (V,) the seed's number, -1 there.

    Args:
        seeds: (S,) vertices.
        begun: (S,) metres to be added to the distance from each; None: 0.
    """
    n, seeds = len(graph.start) - 1, np.asarray(seeds, np.int64)
    distance, owner = np.empty(n), np.empty(n, np.int32)
    kernels.shortest_paths(*graph, seeds, np.zeros(len(seeds)) if begun is None else begun, distance, owner)
    return distance, owner


def owners(vertices: np.ndarray, graph: Graph, seeds: np.ndarray) -> np.ndarray:
    """(V,) number of the seed that is nearest along the surface, or through the air in a piece without a seed.

    Args:
        vertices: (V, 3) metres.
        graph: their edges.
        seeds: (S,) of them.
    """
    _, owner = distances(graph, seeds)
    apart = owner < 0
    if apart.any():
        owner[apart] = nearest_points(vertices[seeds], vertices[apart])
    return owner.astype(np.int64)


def nearest_points(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """(N,) number of the nearest of points (W, 3) for each query (N, 3); at least one point."""
    longest = np.roll(np.arange(3), -int(np.argmax(np.ptp(points, axis=0))))
    order = np.argsort(points[:, longest[0]], kind="stable")
    nearest = np.zeros(len(queries), np.int64)
    ordered, asked = (np.ascontiguousarray(array[:, longest], np.float64) for array in (points[order], queries))
    kernels.nearest_points(ordered, asked, nearest)
    return order[nearest]

"""Geodesic distance: shortest paths along the edges of a mesh, and the nearest of some points through the air."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def shortest_paths(start, neighbour, length, seeds, begun, distance, owner):
    """Finds the shortest paths from the nearest of some seeds (Dijkstra 1959, with a binary heap).

    Args:
        start, neighbour, length: one-rings in compressed rows; metres.
        seeds: (S,) vertices.
        begun: (S,) metres, the length that a path has at its seed.
        distance: (V,) out, metres; infinite where no seed is reached.
        owner: (V,) int32 out, in [0, S): the seed at the path's end; -1 where none is.
    """
    key, item = np.empty(len(neighbour) + len(seeds)), np.empty(len(neighbour) + len(seeds), np.int32)
    size = 0
    distance[:] = np.inf
    owner[:] = -1
    for k in range(len(seeds)):
        if begun[k] < distance[seeds[k]]:
            distance[seeds[k]], owner[seeds[k]] = begun[k], k
            size = push(key, item, size, begun[k], seeds[k])
    while size > 0:
        reached, i = key[0], item[0]
        size = pop(key, item, size)
        if reached > distance[i]:
            continue  # a shorter path came after this entry
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            through = reached + length[e]
            if through < distance[j]:
                distance[j], owner[j] = through, owner[i]
                size = push(key, item, size, through, j)


@njit(nogil=True, cache=True, error_model="numpy")
def number_pieces(start, neighbour, piece):
    """Numbers the pieces that edges join; returns their number.

    Args:
        start, neighbour: one-rings in compressed rows.
        piece: (V,) out, of each vertex.
    """
    waiting = np.empty(len(piece), np.int64)
    piece[:] = -1
    pieces = 0
    for first in range(len(piece)):
        if piece[first] >= 0:
            continue
        piece[first], waiting[0], count = pieces, first, 1
        while count > 0:
            count -= 1
            i = waiting[count]
            for e in range(start[i], start[i + 1]):
                j = neighbour[e]
                if piece[j] < 0:
                    piece[j], waiting[count] = pieces, j
                    count += 1
        pieces += 1
    return pieces


@njit(nogil=True, cache=True, error_model="numpy")
def precedes(key, item, other_key, other_item):
    """Whether an entry leaves the heap before another; of equal keys the greater item does."""
    return key < other_key or (key == other_key and item > other_item)


@njit(nogil=True, cache=True, error_model="numpy")
def push(key, item, size, new_key, new_item):
    """Adds an entry to a heap of ``size`` entries; returns the new size."""
    at = size
    while at > 0:
        parent = (at - 1) >> 1
        if not precedes(new_key, new_item, key[parent], item[parent]):
            break
        key[at], item[at] = key[parent], item[parent]
        at = parent
    key[at], item[at] = new_key, new_item
    return size + 1


@njit(nogil=True, cache=True, error_model="numpy")
def pop(key, item, size):
    """Removes the first entry of a heap of ``size`` entries; returns the new size."""
    size -= 1
    last_key, last_item = key[size], item[size]
    at = 0
    while 2 * at + 1 < size:
        child = 2 * at + 1
        if child + 1 < size and precedes(key[child + 1], item[child + 1], key[child], item[child]):
            child += 1
        if not precedes(key[child], item[child], last_key, last_item):
            break
        key[at], item[at] = key[child], item[child]
        at = child
    key[at], item[at] = last_key, last_item
    return size


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_points(points, queries, nearest):
    """Finds the nearest of some points, by a search to both sides along the first axis.

    Args:
        points: (W, 3) metres, in the order of their first coordinate.
        queries: (N, 3) metres.
        nearest: (N,) out, in [0, W).
    """
    for i in range(queries.shape[0]):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        right = np.searchsorted(points[:, 0], x)
        left = right - 1
        least = np.inf
        while left >= 0 or right < points.shape[0]:
            before = x - points[left, 0] if left >= 0 else np.inf
            after = points[right, 0] - x if right < points.shape[0] else np.inf
            if min(before, after) ** 2 >= least:
                break
            at = left if before <= after else right
            squared = (points[at, 0] - x) ** 2 + (points[at, 1] - y) ** 2 + (points[at, 2] - z) ** 2
            if squared < least:
                least, nearest[i] = squared, at
            if before <= after:
                left -= 1
            else:
                right += 1

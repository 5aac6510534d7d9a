"""Coding of a mesh's vertices over time: each step is predicted from the steps of neighbours that are already known.

Coordinates are whole multiples of a quantum. A vertex moves between frames about as its neighbours do, so that what remains of
its step after the mean step of its earlier neighbours is small, and deflate squeezes it to about half the size of second
differences in time. Decoding restores the multiples exactly.
"""

from __future__ import annotations

from collections import deque

import numpy as np

SMALL, WIDE = np.int8, np.int16  # of residuals: the narrower where all fit


def encode(steps: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Residuals (T - 1, 3, V) of coordinates (T, V, 3) in quanta, int8 or int16.

    Args:
        steps: (T, V, 3) int64.
        faces: (F, 3).

    Raises:
        OverflowError: a residual that int16 does not hold; the message is the largest one.
    """
    moved = np.diff(steps, axis=0).transpose(1, 0, 2)
    residuals = np.empty_like(moved)
    for vertex, known in _earlier_neighbours(faces, steps.shape[1]):
        residuals[vertex] = moved[vertex] - _prediction(moved, known)
    largest = int(np.abs(residuals).max(initial=0))
    if largest > np.iinfo(WIDE).max:
        raise OverflowError(largest)
    kind = SMALL if largest <= np.iinfo(SMALL).max else WIDE
    return np.ascontiguousarray(residuals.transpose(1, 2, 0), kind)


def decode(first: np.ndarray, residuals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Coordinates (T, V, 3) int64 in quanta, from those of the first frame (V, 3) and the residuals of :func:`encode`."""
    moved = np.ascontiguousarray(residuals.transpose(2, 0, 1), np.int64)
    for vertex, known in _earlier_neighbours(faces, len(first)):
        moved[vertex] += _prediction(moved, known)
    return np.cumsum(np.concatenate([first[None].astype(np.int64), moved.transpose(1, 0, 2)]), axis=0)


def _prediction(moved: np.ndarray, known: list[int]) -> np.ndarray | int:
    """(T - 1, 3) mean step of the known neighbours, rounded as integers are: the same on every machine."""
    if not known:
        return 0
    total = moved[known].sum(axis=0)
    return (2 * total + len(known)) // (2 * len(known))


def _earlier_neighbours(faces: np.ndarray, n_vertices: int) -> list[tuple[int, list[int]]]:
    """Every vertex in breadth-first order, with its neighbours that come before it."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    a, b = np.unique(np.sort(edges, axis=1), axis=0).T
    neighbours: list[list[int]] = [[] for _ in range(n_vertices)]
    for one, other in zip(a.tolist(), b.tolist(), strict=True):
        neighbours[one].append(other)
        neighbours[other].append(one)
    order, known = [], np.zeros(n_vertices, bool)
    queued = np.zeros(n_vertices, bool)
    for start in range(n_vertices):
        waiting = deque([] if queued[start] else [start])
        queued[start] = True
        while waiting:
            vertex = waiting.popleft()
            order.append((vertex, [other for other in neighbours[vertex] if known[other]]))
            known[vertex] = True
            fresh = sorted(other for other in neighbours[vertex] if not queued[other])
            queued[fresh] = True
            waiting.extend(fresh)
    return order

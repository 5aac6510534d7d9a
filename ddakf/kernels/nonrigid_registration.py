"""Nonrigid registration: local and global steps of an as-rigid-as-possible graph of clusters."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels.rigidity import LANES, turn

ROTATION_STEPS = 3  # of the iteration of kernels.rigidity.turn


class ClusterGraph(NamedTuple):
    """Edges between neighbouring clusters, G of them."""

    ends: np.ndarray  # (G, 2) int32 the two clusters, both ways
    rest: np.ndarray  # (G, 3) m, from the first one's centre to the second's, in the source
    weight: float  # of an edge


class Goals(NamedTuple):
    """Vertices that pull their clusters, M of them."""

    cluster: np.ndarray  # (M,) int32 cluster of each vertex
    arm: np.ndarray  # (3, M) m, vertex less the centre of its cluster, in the source
    mass: np.ndarray  # (M,) weight of each vertex; they are divided by their sum
    position: np.ndarray  # (3, M) m, where it should be


@njit(nogil=True, cache=True, error_model="numpy")
def settle(goals, graph, rounds, center, rotation):
    """Moves clusters towards their goals, held together by the graph: local and global steps (Sorkine and Alexa 2007).

    Args:
        goals: :class:`Goals`.
        graph: :class:`ClusterGraph`.
        rounds: of a local and a global step each.
        center: (K, 3) in and out, metres.
        rotation: (K, 3, 3) in and out.
    """
    cluster, arm, mass, goal = goals
    ends, rest, edge = graph
    K, M = center.shape[0], len(cluster)
    whole = 0.0
    for m in range(M):
        whole += mass[m]
    A, weight = np.zeros((K, K)), np.zeros(K)
    for m in range(M):
        weight[cluster[m]] += mass[m] / whole
    slack = 1e-6 / K
    for k in range(K):
        A[k, k] = weight[k] + slack
    for g in range(ends.shape[0]):
        i, j = ends[g, 0], ends[g, 1]
        A[i, i] += edge
        A[i, j] -= edge
    factor(A)
    force, spread = np.empty((K, 3)), np.empty((K, 3, 3))
    for _ in range(rounds):
        for k in range(K):
            for a in range(3):
                force[k, a] = slack * center[k, a]
        for m in range(M):
            k, w = cluster[m], mass[m] / whole
            for a in range(3):
                reach = rotation[k, a, 0] * arm[0, m] + rotation[k, a, 1] * arm[1, m] + rotation[k, a, 2] * arm[2, m]
                force[k, a] += w * (goal[a, m] - reach)
        for g in range(ends.shape[0]):
            i, j = ends[g, 0], ends[g, 1]
            for a in range(3):
                for b in range(3):
                    force[i, a] -= 0.5 * edge * (rotation[i, a, b] + rotation[j, a, b]) * rest[g, b]
        solve(A, force)
        center[:] = force
        spread[:] = 0.0
        for g in range(ends.shape[0]):
            i, j = ends[g, 0], ends[g, 1]
            for a in range(3):
                for b in range(3):
                    spread[i, a, b] += edge * (center[j, a] - center[i, a]) * rest[g, b]
        for m in range(M):
            k, w = cluster[m], mass[m] / whole
            for a in range(3):
                for b in range(3):
                    spread[k, a, b] += w * (goal[a, m] - center[k, a]) * arm[b, m]
        rotate(spread, rotation)


@njit(nogil=True, cache=True, error_model="numpy")
def rotate(spread, rotation):
    """Turns rotations (K, 3, 3), in and out, towards the polar factors of ``spread`` (K, 3, 3)."""
    K = len(rotation)
    lanes = np.ones(18 * LANES, np.float32)
    for first in range(0, K, LANES):
        size = min(LANES, K - first)
        for k in range(size):
            scale = 1e-30
            for a in range(3):
                for b in range(3):
                    scale += abs(spread[first + k, a, b])
            for a in range(3):
                for b in range(3):
                    lanes[(3 * b + a) * LANES + k] = spread[first + k, a, b] / scale
                    lanes[(9 + 3 * b + a) * LANES + k] = rotation[first + k, a, b]
        for _ in range(ROTATION_STEPS):
            turn(lanes)
        for k in range(size):
            for a in range(3):
                for b in range(3):
                    rotation[first + k, a, b] = lanes[(9 + 3 * b + a) * LANES + k]


@njit(nogil=True, cache=True, error_model="numpy")
def factor(A):
    """A (K, K) in: symmetric positive definite; out: its Cholesky factor in the lower triangle."""
    K = len(A)
    for i in range(K):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = sqrt(total) if i == j else total / A[j, j]


@njit(nogil=True, cache=True, error_model="numpy")
def solve(L, b):
    """b (K, 3) in: right-hand sides; out: solutions of L L' x = b."""
    K = len(L)
    for i in range(K):
        for k in range(i):
            for a in range(3):
                b[i, a] -= L[i, k] * b[k, a]
        for a in range(3):
            b[i, a] /= L[i, i]
    for i in range(K - 1, -1, -1):
        for a in range(3):
            b[i, a] /= L[i, i]
        for k in range(i):
            for a in range(3):
                b[k, a] -= L[i, k] * b[i, a]


@njit(nogil=True, cache=True, error_model="numpy")
def blend(position, nearest, share, source, center, rotation, moved):
    """Moves vertices with their clusters.

    Args:
        position: (V, 3) metres, in the source.
        nearest, share: (V, N) clusters that a vertex follows, and by how much; rows of ``share`` sum to one.
        source, center: (K, 3) centres of the clusters before and after, metres.
        rotation: (K, 3, 3) of the clusters.
        moved: (V, 3) out, metres.
    """
    for i in range(len(position)):
        for a in range(3):
            total = 0.0
            for m in range(nearest.shape[1]):
                k = nearest[i, m]
                at = center[k, a]
                for b in range(3):
                    at += rotation[k, a, b] * (position[i, b] - source[k, b])
                total += share[i, m] * at
            moved[i, a] = total

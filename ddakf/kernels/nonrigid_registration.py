"""Initialisation, second half: one step of an as-rigid-as-possible graph of patches."""

from math import sqrt

import numpy as np
from numba import njit

from ddakf.kernels.rigidity import LANES, turn

ROTATION_STEPS = 3  # of the iteration of kernels.rigidity.turn


@njit(nogil=True, cache=True, error_model="numpy")
def settle(patch, arm, mass, goal, ends, rest, edge, rounds, middle, rotation):
    """Where patches go that follow their goals and each other: ``rounds`` local and global steps (Sorkine and Alexa 2007).

    Args:
        patch: (M,) int32 patch of each vertex.
        arm: (3, M) vertex less the middle of its patch, in the source, metres.
        mass: (M,) weight of each vertex; they are divided by their sum.
        goal: (3, M) where it should be, metres.
        ends: (G, 2) int32 neighbouring patches, both ways.
        rest: (G, 3) from the first one's middle to the second's, in the source, metres.
        edge: weight of an edge.
        middle: (K, 3) in and out, metres.
        rotation: (K, 3, 3) in and out.
    """
    K, M = middle.shape[0], len(patch)
    whole = 0.0
    for m in range(M):
        whole += mass[m]
    A, weight = np.zeros((K, K)), np.zeros(K)
    for m in range(M):
        weight[patch[m]] += mass[m] / whole
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
                force[k, a] = slack * middle[k, a]
        for m in range(M):
            k, w = patch[m], mass[m] / whole
            for a in range(3):
                reach = rotation[k, a, 0] * arm[0, m] + rotation[k, a, 1] * arm[1, m] + rotation[k, a, 2] * arm[2, m]
                force[k, a] += w * (goal[a, m] - reach)
        for g in range(ends.shape[0]):
            i, j = ends[g, 0], ends[g, 1]
            for a in range(3):
                for b in range(3):
                    force[i, a] -= 0.5 * edge * (rotation[i, a, b] + rotation[j, a, b]) * rest[g, b]
        solve(A, force)
        middle[:] = force
        spread[:] = 0.0
        for g in range(ends.shape[0]):
            i, j = ends[g, 0], ends[g, 1]
            for a in range(3):
                for b in range(3):
                    spread[i, a, b] += edge * (middle[j, a] - middle[i, a]) * rest[g, b]
        for m in range(M):
            k, w = patch[m], mass[m] / whole
            for a in range(3):
                for b in range(3):
                    spread[k, a, b] += w * (goal[a, m] - middle[k, a]) * arm[b, m]
        rotate(spread, rotation)


@njit(nogil=True, cache=True, error_model="numpy")
def rotate(spread, rotation):
    """rotation (K, 3, 3) in and out: towards the polar factors of ``spread`` (K, 3, 3)."""
    K = len(rotation)
    lanes = np.ones((18, LANES), np.float32)
    for first in range(0, K, LANES):
        size = min(LANES, K - first)
        for k in range(size):
            scale = 1e-30
            for a in range(3):
                for b in range(3):
                    scale += abs(spread[first + k, a, b])
            for a in range(3):
                for b in range(3):
                    lanes[3 * b + a, k] = spread[first + k, a, b] / scale
                    lanes[9 + 3 * b + a, k] = rotation[first + k, a, b]
        for _ in range(ROTATION_STEPS):
            turn(lanes)
        for k in range(size):
            for a in range(3):
                for b in range(3):
                    rotation[first + k, a, b] = lanes[9 + 3 * b + a, k]


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
def blend(position, nearest, share, source, middle, rotation, moved):
    """moved (V, 3) out: ``position`` (V, 3) with patches gone from ``source`` (K, 3) to ``middle`` (K, 3), turned by ``rotation``
    (K, 3, 3); each vertex follows its ``nearest`` (V, P) patches by their ``share`` (V, P)."""
    for i in range(len(position)):
        for a in range(3):
            total = 0.0
            for m in range(nearest.shape[1]):
                k = nearest[i, m]
                at = middle[k, a]
                for b in range(3):
                    at += rotation[k, a, b] * (position[i, b] - source[k, b])
                total += share[i, m] * at
            moved[i, a] = total

"""Binding of a garment to the body: smooth skinning to several samples of its surface per vertex, weighted by distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from ddakf.evaluation.baselines.linear_algebra import best_rotations


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of ``count`` of the points (N, 3), each the farthest from those before it, beginning with the first (Gonzalez
    1985). Unlike a grid it does not depend on the axes; evenly spread samples do not depend on where the mesh is fine."""
    chosen = np.zeros(min(count, len(points)), np.int64)
    distance = np.full(len(points), np.inf)
    for k in range(1, len(chosen)):
        step = points - points[chosen[k - 1]]
        np.minimum(distance, np.einsum("na,na->n", step, step), out=distance)
        chosen[k] = distance.argmax()
    return chosen


def gaussian_weights(
    places: np.ndarray, samples: np.ndarray, count: int, reach: float, growth: float = 0.0
) -> tuple[sparse.csr_array, np.ndarray]:
    """Sparse (Q, S) weights of the ``count`` samples (S, 3) nearest to each place (Q, 3), rows of sum 1, and the distance (Q,)
    of the nearest; metres. Their standard deviation is ``reach`` + ``growth`` times that distance."""
    count = min(count, len(samples))
    distance, nearest = cKDTree(samples).query(places, np.arange(1, count + 1))
    sd = reach + growth * distance[:, :1]
    weights = np.exp((distance[:, :1] ** 2 - distance**2) / (2 * sd**2))
    weights /= weights.sum(axis=1, keepdims=True)
    rows = np.arange(0, weights.size + 1, count)
    return sparse.csr_array((weights.ravel(), nearest.ravel(), rows), (len(places), len(samples))), distance[:, 0]


@dataclass(frozen=True)
class Skinning:
    """Places that ride on samples of a surface: each on the best rigid motion of the samples around it.

    Attributes:
        weights: sparse (Q, S), see :func:`gaussian_weights`.
        levers: sparse (3 Q, S), row 3 q + a: the weights times component a of the samples' places at the start, from ``centre``.
        centre: (Q, 3) weighted mean of the samples at the start, metres.
        offset: (Q, 3) of the places from it.
    """

    weights: sparse.csr_array
    levers: sparse.csr_array
    centre: np.ndarray
    offset: np.ndarray

    @classmethod
    def at_start(cls, weights: sparse.csr_array, places: np.ndarray, samples: np.ndarray) -> Skinning:
        """The skinning of places (Q, 3) to samples (S, 3), both at the start, metres."""
        count = weights.indptr[1] - weights.indptr[0]
        nearest, centre = weights.indices.reshape(-1, count), weights @ samples
        arms = weights.data.reshape(-1, 1, count) * (samples[nearest] - centre[:, None]).transpose(0, 2, 1)
        column, rows = np.repeat(nearest[:, None], 3, axis=1).ravel(), np.arange(0, arms.size + 1, count)
        levers = sparse.csr_array((arms.ravel(), column, rows), (3 * len(places), len(samples)))
        return cls(weights, levers, centre, places - centre)

    def carry(self, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rotations R (Q, 3, 3) and centres c (Q, 3) that minimise sum_j w_j |s_j - c - R (p_j - c_0)|^2, for the samples' places
        (S, 3) now and p at the start, and the places (Q, 3) that they give; metres."""
        products = (self.levers @ samples).reshape(-1, 3, 3).transpose(0, 2, 1)
        rotation, centre = best_rotations(products), self.weights @ samples
        return rotation, centre, centre + np.einsum("qab,qb->qa", rotation, self.offset)

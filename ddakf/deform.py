"""Initialisation, second half: a placed garment follows the cloud as an as-rigid-as-possible graph of its patches.

The patches are those of the solver's coarse level. Each has a position and a rotation; correspondences are sought in both
directions: a sleeve that lies elsewhere finds no point of its own, while the cloud's points find the sleeve. Local and global
steps alternate (Sorkine and Alexa 2007) while the graph becomes softer.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ddakf.associate import OCCLUDER_CELL
from ddakf.kernels.associate import seen, vertex_normals
from ddakf.model import Model

TRUNCATION = 0.10  # m: points farther from the garment count as this far
STEPS = 20
STIFF, SOFT, HALF_SEEN = 5.0, 0.02, 2.0  # weight of an edge against the data of a patch: first, last, last with one sensor
REACH = 1.5 * TRUNCATION  # m: correspondences farther apart are none
SAMPLE, DENSE = 400, 1000  # vertices and points that ask, and vertices that answer
HIDDEN_DEPTH, FACING = 0.03, 0.1  # m, cosine: what a sensor sees, as in stage B
NO_BODY = np.empty((0, 3))


class Target(NamedTuple):
    """The cloud that a garment is laid on."""

    points: np.ndarray  # (N, 3) m, a sample
    tree: cKDTree  # of a denser one
    eye: np.ndarray | None  # (3,) m, the sensor; None: seen from all around

    @classmethod
    def of(cls, points: np.ndarray, sensor_origin: np.ndarray | None, count: int) -> Target:
        points = points.astype(np.float64)
        eye = sensor_origin if sensor_origin is not None and sensor_origin.ndim == 1 else None
        return cls(points[:: max(1, len(points) // count)], cKDTree(points[:: max(1, len(points) // (12 * count))]), eye)


class Graph(NamedTuple):
    """Patches of a garment and how they move its vertices."""

    patch: np.ndarray  # (V,) of each vertex
    ends: np.ndarray  # (G, 2) neighbouring patches, both ways
    weight: np.ndarray  # (V, K) share of each patch in a vertex, rows add up to 1
    middle: np.ndarray  # (K, 3) m, of the patches of the source


def graph(position: np.ndarray, model: Model, chosen: np.ndarray) -> Graph:
    """The patches of a garment that lies at ``position`` (V, 3), with the weights of the ``chosen`` vertices."""
    K = model.n_clusters
    size = np.bincount(model.cluster, minlength=K)
    middle = np.stack([np.bincount(model.cluster, position[:, a], K) for a in range(3)], axis=1) / size[:, None]
    touching = np.zeros((K, K), bool)
    touching[np.repeat(model.cluster, np.diff(model.start)), model.cluster[model.neighbour]] = True
    np.fill_diagonal(touching, False)
    ends = np.argwhere(touching)
    return Graph(model.cluster[chosen], ends, _weights(position, model, chosen, middle, ends), middle)


def _weights(position: np.ndarray, model: Model, chosen: np.ndarray, middle: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(C, K) share of each patch in the ``chosen`` vertices (C,): of their own and its neighbours."""
    spacing = np.linalg.norm(middle[ends[:, 0]] - middle[ends[:, 1]], axis=1).mean() if len(ends) else 1.0
    spacing = max(spacing, 1e-9)
    near = np.eye(len(middle), dtype=bool)
    near[ends[:, 0], ends[:, 1]] = True
    near = near[model.cluster[chosen]]
    away = np.where(near, cdist(position[chosen], middle, "sqeuclidean") / spacing**2, np.inf)
    weight = np.exp(-2.0 * (away - away.min(axis=1, keepdims=True)))
    return weight / weight.sum(axis=1, keepdims=True)


def moved(position: np.ndarray, patches: Graph, middle: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(V, 3) the source's vertices with its patches at ``middle`` (K, 3) and turned by ``rotation`` (K, 3, 3)."""
    shift = middle - np.einsum("kab,kb->ka", rotation, patches.middle)
    turned = (patches.weight @ rotation.reshape(-1, 9)).reshape(-1, 3, 3)
    return np.einsum("vab,vb->va", turned, position) + patches.weight @ shift


def follow(
    position: np.ndarray, points: np.ndarray, sensor_origin: np.ndarray | None, model: Model, steps: int = STEPS
) -> np.ndarray:
    """(V, 3) the garment, bent onto the cloud.

    Args:
        position: (V, 3) where the rigid search has laid it, metres.
        points: (N, 3) metres.
        sensor_origin: (3,) metres: what is turned away from it has no points; None or (N, 3): every side has.
        model: the garment.
    """
    source, K, normal = position, model.n_clusters, np.empty_like(position)
    vertex_normals(source, model.faces, normal)
    every = max(1, len(source) // DENSE)
    chosen = np.arange(0, len(source), every)
    patches, target = graph(source, model, chosen), Target.of(points, sensor_origin, SAMPLE)
    position, normal = source[chosen], normal[chosen]
    cell = OCCLUDER_CELL * model.edge_length * np.sqrt(every)
    middle, rotation = patches.middle.copy(), np.tile(np.eye(3), (K, 1, 1))
    a, b = patches.ends.T
    rest = patches.middle[b] - patches.middle[a]
    laplacian = np.zeros((K, K))
    np.add.at(laplacian, (a, a), 1.0)
    np.add.at(laplacian, (a, b), -1.0)
    estimate, soft = position, SOFT if target.eye is None else HALF_SEEN
    for step in range(steps):
        vertex, goal, trust = _pairs(estimate, _turned(normal, patches, rotation), target, cell)
        if len(vertex) == 0:
            return source
        patch = patches.patch[vertex]
        trust = trust / trust.sum()
        arm = position[vertex] - patches.middle[patch]
        edge = STIFF * (soft / STIFF) ** (step / (steps - 1)) / K
        for _ in range(2):
            # global: each patch where its data and its neighbours want it
            pull = goal - np.einsum("nab,nb->na", rotation[patch], arm)
            force = np.zeros((K, 3))
            np.add.at(force, patch, trust[:, None] * pull)
            wanted = 0.5 * edge * np.einsum("gab,gb->ga", rotation[a] + rotation[b], rest)
            np.add.at(force, a, -wanted)
            mass = np.bincount(patch, trust, K)
            middle = np.linalg.solve(edge * laplacian + np.diag(mass + 1e-6 / K), force + 1e-6 / K * middle)
            # local: the turn that fits a patch's neighbours and its data
            spread = np.zeros((K, 3, 3))
            np.add.at(spread, a, edge * (middle[b] - middle[a])[:, :, None] * rest[:, None, :])
            np.add.at(spread, patch, (trust[:, None] * (goal - middle[patch]))[:, :, None] * arm[:, None, :])
            U, _, Vt = np.linalg.svd(spread)
            U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
            rotation = U @ Vt
        estimate = moved(position, patches, middle, rotation)
    weight = _weights(source, model, np.arange(len(source)), patches.middle, patches.ends)
    return moved(source, patches._replace(patch=model.cluster, weight=weight), middle, rotation)


def _turned(normal: np.ndarray, patches: Graph, rotation: np.ndarray) -> np.ndarray:
    return np.einsum("vab,vb->va", rotation[patches.patch], normal)


def _pairs(position: np.ndarray, normal: np.ndarray, target: Target, cell: float) -> tuple[np.ndarray, ...]:
    """Vertices (P,), the points (P, 3) they should be at, and how much each pair counts: points' pairs, then vertices'."""
    visible = np.ones(len(position), bool)
    if target.eye is not None:
        seen(position, normal, NO_BODY, target.eye[None], cell, HIDDEN_DEPTH, FACING, visible)
    chosen = np.flatnonzero(visible)
    if len(chosen) == 0:
        return chosen, np.empty((0, 3)), np.empty(0)
    there, nearest = cKDTree(position[chosen]).query(target.points, distance_upper_bound=REACH)
    found = np.isfinite(there)
    some = chosen[:: max(1, len(chosen) // SAMPLE)]
    back, index = target.tree.query(position[some], distance_upper_bound=REACH)
    near = np.isfinite(back)
    vertex = np.concatenate([chosen[nearest[found]], some[near]])
    goal = np.concatenate([target.points[found], target.tree.data[index[near]]])
    distance = np.concatenate([there[found], back[near]])
    return vertex, goal, np.square(1.0 - np.square(distance / REACH))

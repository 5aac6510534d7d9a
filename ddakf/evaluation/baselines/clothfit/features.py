"""Features of ClothFit's network, in local axes: a vertex's place on the body, and the motion of the body nearby.

A vertex is bound to the body by smooth skinning (:mod:`.binding`). Its frame is the best rigid motion (R, c) of the body's
surface around it since the start, and ``carried`` is where that motion takes it. All vectors are given in that frame, as
R' v, and the network answers with a combination of them (:mod:`.network`): so nothing depends on the axes of the world, on
the direction in which the body looks, or on left and right. Metres, seconds, y up.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ddakf.evaluation.baselines.clothfit.binding import Skinning, gaussian_weights, spread
from ddakf.evaluation.baselines.clothfit.inputs import ACCELERATION, CLOTH, CLOTH_REACHES, LENGTH, Inputs
from ddakf.evaluation.baselines.clothfit.motion import Motion
from ddakf.mesh import Mesh, vertex_normals

DOWN = np.array([0.0, -1.0, 0.0])  # y up
BODY_SAMPLES, GARMENT_SAMPLES = 1500, 500  # spread over the surfaces
BINDING, REACH, REACH_GROWTH = 16, 0.03, 0.4  # samples of the body that carry a vertex; m and 1: see gaussian_weights
NEARBY, NEARBY_REACH = 96, 0.12  # samples of the body whose motion against its frame a vertex sees; m
LONGEST = 2.0  # units: vectors of change are bent back to be shorter than this
TALL, LONG, HEM, DEEP = 1.6, 0.3, 0.1, 0.02  # m: units of the scalars
FAR = 3.0  # units: scalars beyond are all alike
FADE = 0.5  # s: how long the start is remembered


class Features:
    """The inputs of a garment, frame by frame.

    Args:
        garment: its vertices are the rest shape.
        start: (V, 3) its vertices before the first frame, metres.
        body: in the pose of the start.
        queries: indices of the vertices to compute; all by default.
    """

    def __init__(self, garment: Mesh, start: np.ndarray, body: Mesh, queries: np.ndarray | None = None):
        start, self._body_faces = np.asarray(start, np.float64), body.faces
        queries = np.arange(len(start)) if queries is None else queries
        self._count, self._samples = len(queries), spread(body.vertices, BODY_SAMPLES)
        support = spread(garment.vertices, GARMENT_SAMPLES)
        places, samples = start[np.concatenate([queries, support])], body.vertices[self._samples]
        weights, distance = gaussian_weights(places, samples, BINDING, REACH, REACH_GROWTH)
        self._skinning = Skinning.at_start(weights, places, samples)
        skin = (weights @ vertex_normals(body.vertices, body.faces)[self._samples])[: self._count]
        offset = self._skinning.offset[: self._count] / LENGTH
        self._still = np.stack([skin, offset, vertex_normals(start, garment.faces)[queries]], axis=1)
        self._nearby, _ = gaussian_weights(start[queries], samples, NEARBY, NEARBY_REACH)
        rest, rest_support = garment.vertices[queries], garment.vertices[support]
        self._cloth = [gaussian_weights(rest, rest_support, CLOTH, reach)[0] for reach in CLOTH_REACHES]
        self._about_at_start = self._about(*np.split(places, [self._count]), self._skinning.centre[: self._count], samples)
        hem = garment.vertices[garment.boundary_vertices]
        to_hem = cKDTree(hem).query(rest)[0] if len(hem) else np.full(len(rest), np.inf)
        height, top = -(start[queries] @ DOWN), -(start @ DOWN).min()
        on_body = (height + (body.vertices @ DOWN).max()) / TALL
        self._still_scalars = np.stack([distance[: self._count] / LENGTH, on_body, (top - height) / LONG, to_hem / HEM])
        self._motion = Motion(start[queries])

    def step(self, body_vertices: np.ndarray, timestamp: float) -> Inputs:
        """The next frame: the body's vertices (B, 3), metres, and its time."""
        body = np.asarray(body_vertices, np.float64)
        samples = body[self._samples]
        rotation, centre, everything = self._skinning.carry(samples)
        carried, support = np.split(everything, [self._count])
        rotation, centre = rotation[: self._count], centre[: self._count]
        motion = self._motion.step(carried, timestamp)
        normal, depth = self._skin(carried, body)
        down = np.broadcast_to(DOWN, carried.shape)
        accelerations = motion.acceleration / ACCELERATION, motion.mean_acceleration / ACCELERATION
        about = self._about(carried, support, centre, samples)
        world = np.stack([down, normal, *accelerations, *(swing / LENGTH for swing in motion.swings), *about], axis=1)
        local = np.einsum("qba,qvb->qva", rotation, world)
        local[:, -len(about) :] -= np.stack(self._about_at_start, axis=1)
        still = np.concatenate([self._still, local[:, :2]], axis=1)
        change = np.insert(local[:, 2:], 0, local[:, 0] - DOWN, axis=1)
        time = np.full(self._count, 1 - np.exp(-motion.elapsed / FADE))
        scalars = np.clip(np.stack([*self._still_scalars, time, depth / DEEP], axis=1), -FAR, FAR)
        return Inputs(carried, rotation, np.concatenate([still, bent(change)], axis=1), scalars)

    def _about(self, queries: np.ndarray, support: np.ndarray, centre: np.ndarray, samples: np.ndarray) -> list[np.ndarray]:
        """(Q, 3) vectors, in LENGTH, from each query to the cloth around it, and from its centre to the body around it."""
        cloth = [(weights @ support - queries) / LENGTH for weights in self._cloth]
        return [*cloth, (self._nearby @ samples - centre) / LENGTH]

    def _skin(self, queries: np.ndarray, body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normals (Q, 3) of the nearest vertices of the body now, and the distances (Q,) of the queries outside their planes."""
        _, nearest = cKDTree(body).query(queries)
        normal = vertex_normals(body, self._body_faces)[nearest]
        return normal, np.einsum("qa,qa->q", queries - body[nearest], normal)


def bent(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of the same directions, no longer than LONGEST; short ones stay as they are."""
    return vectors / np.sqrt(1 + np.square(vectors / LONGEST).sum(axis=-1, keepdims=True))

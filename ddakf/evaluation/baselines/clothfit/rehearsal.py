"""Rehearsals: coarse simulations for ClothFit's training, made on demand from CC0 parts.

Four garments and seven motions of :mod:`ddakf.evaluation.simulation`, each with each, on the body that ships. About 500
vertices, extended position-based dynamics in small steps (Macklin et al. 2016, 2019): edges, hinges as springs between their
tips, the body's nearest vertex as a plane with friction, no self-collision. A frame takes hundredths of a second, where Newton
takes a good part of a second for the recordings that ship: many coarse motions train better than a few fine ones.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ddakf.data.body import Body, load_body
from ddakf.evaluation.simulation import garments, motions
from ddakf.evaluation.simulation.garments import Garment
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh, vertex_normals

FPS, FRAMES, SETTLING, VERTICES = 30.0, 100, 24, 500  # settling: frames in the rest pose, discarded
SIZES = 2  # cuts of each garment
GARMENTS = ("tshirt", "tank", "skirt", "dress")  # and motions on which the settings were chosen
MOTIONS = ("walk", "swing", "crossed-arms", "jump", "twist", "squat", "dance")
SUBSTEPS = 12  # of a frame
GRAVITY = np.array([0.0, -9.81, 0.0])  # m/s^2
DRAG = 0.6  # 1/s
STRETCH, BEND = 3e-7, 3e-4  # m/N per kg: compliances, of unit masses
THICKNESS, REACH, FRICTION = 0.01, 0.1, 0.4  # m; m, within which the body is met; no unit
TINY = 1e-12  # m: against division by 0


class Rehearsal(NamedTuple):
    """Parameters of one rehearsal."""

    garment: str
    motion: str
    size: int  # seed of the garment's measures
    style: int  # seed of the motion

    @property
    def name(self) -> str:
        return f"{self.garment}_{self.motion}"


def rehearsals() -> list[Rehearsal]:
    """Each garment with each motion."""
    pairs = product(enumerate(GARMENTS), enumerate(MOTIONS))
    return [Rehearsal(g, m, 1 + (i + j) % SIZES, 1 + i * len(MOTIONS) + j) for (i, g), (j, m) in pairs]


def rehearse(chosen: list[Rehearsal], progress: Callable[[int, int], None] = lambda done, total: None) -> list[Sequence]:
    """Simulates rehearsals together, which is quicker than one after another.

    Args:
        chosen: the rehearsals.
        progress: told of frames, as ``progress(done, total)``.
    """
    body = load_body()
    cuts = {key: garments.make(key[0], body, VERTICES, key[1]) for key in {(part.garment, part.size): 0 for part in chosen}}
    dressed = [cuts[part.garment, part.size] for part in chosen]
    poses = [motions.make(part.motion, body, FRAMES, FPS, part.style) for part in chosen]
    bodies = [body.skinned(pose) for pose in poses]
    pins = [body.skinned(pose, body.attach(g.mesh.vertices, g.mesh.faces)) for pose, g in zip(poses, dressed, strict=True)]
    cloth, frames = _Cloth(dressed), []
    numbers = [0] * SETTLING + list(range(FRAMES))
    for done, (before, after) in enumerate(pairwise(numbers), 1):
        now = [(b[before], b[after]) for b in bodies]
        frames.append(cloth.frame(now, body.faces, np.concatenate([p[after] for p in pins])))
        progress(done, len(numbers) - 1)
    whole = np.array(frames[-FRAMES:], np.float32)
    return [_sequence(part, g, whole[:, a:b], body, posed)
            for part, g, a, b, posed in zip(chosen, dressed, cloth.first[:-1], cloth.first[1:], bodies, strict=True)]  # fmt: skip


def _sequence(part: Rehearsal, garment: Garment, vertices: np.ndarray, body: Body, posed: np.ndarray) -> Sequence:
    rest = garment.mesh.vertices.astype(np.float32)
    return Sequence(part.name, vertices, garment.mesh.faces, FPS, rest, posed, body.faces)


class _Cloth:
    """Several garments that do not meet, as one system of unit masses."""

    def __init__(self, dressed: list[Garment]):
        self.first = np.cumsum([0, *(g.mesh.n_vertices for g in dressed)])
        self._x = np.concatenate([g.mesh.vertices for g in dressed])
        self._v = np.zeros_like(self._x)
        self._pinned = np.concatenate([g.pinned for g in dressed])
        edges = np.concatenate([g.mesh.edges + a for g, a in zip(dressed, self.first, strict=False)])
        tips = np.concatenate([hinge_tips(g.mesh) + a for g, a in zip(dressed, self.first, strict=False)])
        self._springs = [*self._groups(tips, BEND), *self._groups(edges, STRETCH)]

    def _groups(self, pairs: np.ndarray, compliance: float) -> list[tuple]:
        """Springs in groups that share no vertex: their ends, lengths, inverse masses and compliance."""
        free = np.where(self._pinned, 0.0, 1.0)[:, None]
        pairs = pairs[(free[pairs[:, 0]] + free[pairs[:, 1]])[:, 0] > 0]
        colour, groups = colours(pairs, len(self._x)), []
        for k in range(colour.max() + 1):
            i, j = pairs[colour == k].T
            length = np.linalg.norm(self._x[i] - self._x[j], axis=1)
            groups.append((i, j, length, free[i], free[j], compliance))
        return groups

    def frame(self, bodies: list[tuple[np.ndarray, np.ndarray]], faces: np.ndarray, pins: np.ndarray) -> np.ndarray:
        """(V, 3) after a frame in which each body moves from vertices (B, 3) to others, and pinned vertices to ``pins``."""
        h = 1 / (FPS * SUBSTEPS)
        place, normal, step, turn = self._contacts(bodies, faces)
        pin, pin_step = self._x[self._pinned], (pins[self._pinned] - self._x[self._pinned]) / SUBSTEPS
        for k in range(1, SUBSTEPS + 1):
            old = self._x.copy()
            self._v += h * (GRAVITY - DRAG * self._v)
            self._x += h * self._v
            self._x[self._pinned] = pin + k * pin_step
            for spring in self._springs:
                self._pull(*spring, h)
            self._keep_out(old, place + k * step, normal + k * turn, step)
            self._v = (self._x - old) / h
        return self._x.copy()

    def _contacts(self, bodies: list[tuple[np.ndarray, np.ndarray]], faces: np.ndarray) -> tuple[np.ndarray, ...]:
        """Place and normal of the body's vertex nearest to each vertex before the frame, and their change in a substep."""
        found = []
        for (before, after), a, b in zip(bodies, self.first[:-1], self.first[1:], strict=True):
            nearest = cKDTree(before).query(self._x[a:b])[1]
            found.append([v[nearest] for mesh in (before, after) for v in (mesh, vertex_normals(mesh, faces))])
        place, normal, place_after, normal_after = (np.concatenate(part).astype(np.float64) for part in zip(*found, strict=True))
        return place, normal, (place_after - place) / SUBSTEPS, (normal_after - normal) / SUBSTEPS

    def _pull(self, i, j, length, free_i, free_j, compliance, h) -> None:
        between = self._x[i] - self._x[j]
        now = np.sqrt(np.einsum("na,na->n", between, between))[:, None]
        move = (now - length[:, None]) / ((free_i + free_j + compliance / h**2) * np.maximum(now, TINY)) * between
        self._x[i] -= free_i * move
        self._x[j] += free_j * move

    def _keep_out(self, old: np.ndarray, place: np.ndarray, normal: np.ndarray, step: np.ndarray) -> None:
        away = self._x - place
        depth = THICKNESS - np.einsum("na,na->n", away, normal)
        hit = (depth > 0) & (np.einsum("na,na->n", away, away) < REACH**2) & ~self._pinned
        n, depth = normal[hit], depth[hit, None]
        self._x[hit] += depth * n
        slide = self._x[hit] - old[hit] - step[hit]
        slide -= np.einsum("na,na->n", slide, n)[:, None] * n
        size = np.linalg.norm(slide, axis=1, keepdims=True)
        self._x[hit] -= np.minimum(1, FRICTION * depth / np.maximum(size, TINY)) * slide


def hinge_tips(mesh: Mesh) -> np.ndarray:
    """(H, 2) the two vertices across each inner edge."""
    corners = np.concatenate([np.roll(mesh.faces, -k, axis=1) for k in range(3)])
    edge = np.sort(corners[:, :2], axis=1)
    order = np.lexsort(edge.T)
    edge, tip = edge[order], corners[order, 2]
    same = np.flatnonzero((edge[1:] == edge[:-1]).all(axis=1))
    return np.stack([tip[same], tip[same + 1]], axis=1)


def colours(pairs: np.ndarray, count: int) -> np.ndarray:
    """(n,) greedy colours of the edges (n, 2) of a graph with ``count`` nodes: no two edges at a node have the same colour."""
    taken: list[set[int]] = [set() for _ in range(count)]
    colour = np.zeros(len(pairs), np.int64)
    for k, (a, b) in enumerate(pairs.tolist()):
        while colour[k] in taken[a] or colour[k] in taken[b]:
            colour[k] += 1
        taken[a].add(int(colour[k]))
        taken[b].add(int(colour[k]))
    return colour

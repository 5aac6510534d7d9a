"""Inputs of the benchmarks: the bundled sample or recordings, seen by a virtual sensor, with a chosen garment size."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

import ddakf
from ddakf import data
from ddakf.evaluation.sensors import Cloud, Sensor
from ddakf.evaluation.sensors.texture import Texture
from ddakf.files.sequence import Sequence, load_sequence

SEED = 1
TEXTURES = {"garment": None, "person": None, "coloured person": Texture("plain")}  # by what a cloud is of


@dataclass(frozen=True, eq=False)
class Run:
    """Frames of one sequence as one sensor sees them; frame 0 is the start, the clouds are those after it.

    Attributes:
        name: for the report.
        sequence: the truth of frames 0 to len(clouds).
        clouds: of the sensor.
        body: the tracker gets the body of every frame.
    """

    name: str
    sequence: Sequence
    clouds: list[Cloud]
    body: bool

    def tracker(self, config: ddakf.Config | None = None) -> ddakf.Tracker:
        """A tracker at the true frame 0."""
        tracker = self.unplaced(config)
        tracker.reset(vertices=self.sequence.garment_vertices[0])
        return tracker

    def unplaced(self, config: ddakf.Config | None = None) -> ddakf.Tracker:
        """A tracker whose garment is where its template is, so that the first frame is searched for it."""
        s = self.sequence
        body = ddakf.Mesh(s.body_vertices[0], s.body_faces) if self.body else None
        return ddakf.Tracker(ddakf.Mesh(s.template, s.garment_faces), body=body, config=config)

    def frames(self) -> Iterator[tuple[int, Cloud, dict]]:
        """Number in the sequence, cloud, and the other arguments of ``Tracker.step``."""
        for number, cloud in enumerate(self.clouds, 1):
            body = self.sequence.body_vertices[number] if self.body else None
            yield (
                number,
                cloud,
                {
                    "timestamp": self.sequence.timestamp(number),
                    "sensor_origin": cloud.sensor_origin,
                    "body_vertices": body,
                },
            )


def run_of(sequence: Sequence, frames: int, view: str, points: int, *, body: bool = False) -> Run:
    """The first ``frames`` frames after the start, as a sensor with 3 mm noise sees them."""
    frames = min(frames, len(sequence) - 1)
    cut = replace(
        sequence,
        garment_vertices=sequence.garment_vertices[: frames + 1],
        body_vertices=None if sequence.body_vertices is None else sequence.body_vertices[: frames + 1],
    )
    sensor = Sensor(view, points)
    clouds = [sensor.capture(cut, k, np.random.default_rng([SEED, k])) for k in range(1, frames + 1)]
    name = f"{sequence.name}, {view}{' + body' if body else ''}"
    return Run(name, cut, clouds, body)


def sequences() -> Iterator[Sequence]:
    """The bundled sample, and the recordings under DDAKF_DATA."""
    yield data.sample()
    folder = Path(os.environ.get("DDAKF_DATA", "")) / "sequences"
    if os.environ.get("DDAKF_DATA") and folder.is_dir():
        for path in sorted(folder.glob("*.npz")):
            yield load_sequence(path)


def resampled(sequence: Sequence, vertices: int) -> Sequence:
    """The same garment and motion with approximately another number of vertices."""
    count = sequence.garment_vertices.shape[1]
    if vertices < count:
        return _coarsened(sequence, vertices)
    return _refined(sequence, vertices)


def _coarsened(sequence: Sequence, count: int) -> Sequence:
    """A subset of the vertices, joined where their geodesic Voronoi regions meet."""
    positions, faces = sequence.template.astype(float), sequence.garment_faces
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    graph = coo_array((length, (edges[:, 0], edges[:, 1])), (len(positions),) * 2).tocsr()
    nearest, owner, seeds = np.full(len(positions), np.inf), np.zeros(len(positions), int), []
    while len(seeds) < count:
        limit = float(nearest.max())
        seeds.append(int(np.argmax(nearest)))
        distance = dijkstra(graph, indices=seeds[-1], limit=limit)
        closer = distance < nearest
        nearest[closer], owner[closer] = distance[closer], len(seeds) - 1
    triangles = owner[faces]
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    mesh, kept = ddakf.Mesh.cleaned(positions[seeds], triangles[distinct])
    return replaced(sequence, lambda v: v[..., np.array(seeds)[kept], :], mesh.faces)


def _refined(sequence: Sequence, count: int) -> Sequence:
    """Edges halved, each the longest of its triangles, until there are ``count`` vertices."""
    while sequence.garment_vertices.shape[1] < count:
        faces, positions = sequence.garment_faces, sequence.template.astype(float)
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        edges, side_edge = np.unique(sides, axis=0, return_inverse=True)
        side_edge = side_edge.reshape(-1, 3)
        length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
        rank = np.empty(len(edges), int)
        rank[np.argsort(length, kind="stable")] = np.arange(len(edges))
        side = rank[side_edge].argmax(axis=1)
        longest = side_edge[np.arange(len(faces)), side]
        wanted = np.flatnonzero(np.bincount(longest, minlength=len(edges)) == np.bincount(side_edge.ravel()))
        wanted = wanted[np.argsort(-length[wanted])][: count - len(positions)]
        middle = np.full(len(edges), -1)
        middle[wanted] = len(positions) + np.arange(len(wanted))
        halved = middle[longest] >= 0
        turned = np.take_along_axis(faces, (side[:, None] + [0, 1, 2]) % 3, axis=1)[halved]
        new = middle[longest[halved]]
        a, b, c = turned.T
        faces = np.concatenate([faces[~halved], np.stack([a, new, c], axis=1), np.stack([new, b, c], axis=1)])
        ends = edges[wanted]
        sequence = replaced(
            sequence,
            lambda v, ends=ends: np.concatenate([v, 0.5 * (v[..., ends[:, 0], :] + v[..., ends[:, 1], :])], axis=-2),
            faces,
        )
    return sequence


def replaced(sequence: Sequence, change, faces: np.ndarray) -> Sequence:
    """The sequence with other vertices, by a function of (..., V, 3) positions, and faces."""
    rest = None if sequence.garment_rest is None else change(sequence.garment_rest).astype(np.float32)
    vertices = change(sequence.garment_vertices).astype(np.float32)
    return replace(sequence, garment_vertices=vertices, garment_faces=faces, garment_rest=rest)


def shortened(sequence: Sequence, frames: int) -> Sequence:
    """The first frames of a sequence, since refining all frames of a large garment is slow."""
    bodies = None if sequence.body_vertices is None else sequence.body_vertices[: frames + 1]
    return replace(sequence, garment_vertices=sequence.garment_vertices[: frames + 1], body_vertices=bodies)

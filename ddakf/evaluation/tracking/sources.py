"""Sources of frames for a tracker: a sequence seen by a virtual sensor, or a real recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Protocol

import numpy as np

from ddakf.data.rotation import rotation_matrices
from ddakf.errors import InvalidArgument
from ddakf.evaluation.datasets import Pair, Recording
from ddakf.evaluation.datasets.captures.cloud_folder import FolderRecording, repaired_mesh
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh

Start = Literal["truth", "rest", "search"]
DISPLACED_TURN, DISPLACED_SHIFT = np.pi, 1.0  # rad, m: largest displacement of a start by search
DESCRIPTION = {"full": "scanned all around", "front": "one depth camera", "ring4": "four depth cameras"}


class Source(Protocol):
    """Frames, and the start of a tracker on them.

    Attributes:
        title: name to display.
        garment: template.
        start: (V, 3) vertices of the garment at the start, or None if only the template is known.
        body: for the tracker, in the pose of the start, or None.
        body_faces: for drawing the body, or None.
        fps: frames per second.
        closed: the garment goes around the person, so that pictures can show its back.
        vertex_map: (V,) vertex of the template's file that each of the garment's is; None: they are the same.
    """

    title: str
    garment: Mesh
    start: np.ndarray | None
    body: Mesh | None
    body_faces: np.ndarray | None
    fps: float
    closed: bool
    vertex_map: np.ndarray | None

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[CapturedFrame]: ...


@dataclass(frozen=True, eq=False)
class SequenceSource:
    """Frames of a sequence with ground truth, seen by a virtual sensor.

    With a start at the truth, the first frame is the start and tracking begins with the second; otherwise with the first.
    Every frame has random numbers of its own, so that a range of frames gives the same clouds as the whole sequence.

    Args:
        sequence: the truth. sensor: the virtual sensor. frames: range of frames.
        start_at: ``truth``: the first frame's vertices; ``rest``: the template in place; ``search``: the template turned and
            moved away at random, so that the tracker has to find the garment.
        give_body: the tracker gets the body of every frame.
        seed: of the sensor's random numbers.
    """

    sequence: Sequence
    sensor: Sensor
    frames: range
    start_at: Start = "truth"
    give_body: bool = False
    seed: int = 1
    closed: bool = field(default=True, init=False)
    vertex_map: None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.give_body and not self.sequence.has_body:
            raise InvalidArgument("body", "a sequence with body_V and body_F", f"{self.sequence.name} without")

    @property
    def title(self) -> str:
        return f"{self.sequence.name}, {DESCRIPTION[self.sensor.view]}"

    @property
    def fps(self) -> float:
        return self.sequence.fps / self.sensor.every

    @cached_property
    def garment(self) -> Mesh:
        rest = self._first if self.sequence.garment_rest is None else self.sequence.garment_rest
        if self.start_at == "search":
            rest = _displaced(rest, np.random.default_rng(self.seed))
        return Mesh(rest, self.sequence.garment_faces)

    @property
    def start(self) -> np.ndarray | None:
        return self._first if self.start_at == "truth" else None

    @property
    def body(self) -> Mesh | None:
        return Mesh(self.sequence.body_vertices[self.frames[0]], self.sequence.body_faces) if self.give_body else None

    @property
    def body_faces(self) -> np.ndarray | None:
        return self.sequence.body_faces

    @property
    def _first(self) -> np.ndarray:
        return self.sequence.garment_vertices[self.frames[0]]

    @property
    def _tracked(self) -> range:
        taken = self.sensor.frames(self.frames)
        return taken[1:] if self.start_at == "truth" else taken

    def __len__(self) -> int:
        return len(self._tracked)

    def __iter__(self) -> Iterator[CapturedFrame]:
        s = self.sequence
        for k in self._tracked:
            cloud = self.sensor.capture(s, k, np.random.default_rng([self.seed, k]))
            body = s.body_vertices[k] if s.has_body else None
            given = body if self.give_body else None
            yield CapturedFrame(k, s.timestamp(k), *cloud, body_vertices=given, truth=s.garment_vertices[k], body=body)


@dataclass(frozen=True, eq=False)
class RecordingSource:
    """Frames of a real sensor. Without a template, the first frame gives one and is not tracked. With one, the tracker searches
    for the garment in the first frame.

    Args:
        recording: the frames.
        sensor: its limit, loss, noise, outliers, occlusion and frame rate are applied; its view is not.
        frames: range of frames.
        garment: template, or None to make it from the recording's first frame.
        seed: of the random numbers.
        vertex_map: (V,) of a template that was repaired, or None.
    """

    recording: Recording
    sensor: Sensor
    frames: range
    template: Mesh | None = None
    seed: int = 1
    vertex_map: np.ndarray | None = None
    garment: Mesh = field(init=False)
    body: None = field(default=None, init=False)
    body_faces: None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.sensor.require_no_camera()
        garment = self.recording.template(self.frames[0]) if self.template is None else self.template
        object.__setattr__(self, "garment", garment)

    @property
    def title(self) -> str:
        return f"{self.recording.name}, recorded"

    @property
    def start(self) -> np.ndarray | None:
        return self.garment.vertices if self.template is None else None

    @property
    def fps(self) -> float:
        return self.recording.fps / self.sensor.every

    @property
    def closed(self) -> bool:
        return self.template is not None

    @property
    def _tracked(self) -> range:
        taken = self.sensor.frames(self.frames)
        return taken[1:] if self.template is None else taken

    def __len__(self) -> int:
        return len(self._tracked)

    def __iter__(self) -> Iterator[CapturedFrame]:
        for k in self._tracked:
            cloud = self.sensor.degrade(self.recording.cloud(k), np.random.default_rng([self.seed, k]), k)
            yield CapturedFrame(k, self.recording.timestamp(k), **cloud._asdict())


def source_of(
    recording: Sequence | Recording | Pair,
    sensor: Sensor | None = None,
    *,
    frames: str = ":",
    start: Start = "truth",
    give_body: bool = False,
    template=None,
    unit: float = 1.0,
    seed: int = 1,
) -> Source:
    """The source that ``ddakf track`` tracks.

    Args:
        recording: a sequence or a recording.
        sensor: default: for sequences one depth camera with 3 mm noise, for recordings nothing is added.
        frames: ``A:B``, from frame A up to B, which is not part of it; either may be left out.
        start: as ``start_at``, give_body, seed: see :class:`SequenceSource`.
        template: mesh file to track in a recording, instead of its first frame.
        unit: metres in a unit of that file.

    Raises:
        InvalidFile, InvalidArgument, InvalidMesh: a file, an argument or a template that is not valid.
    """
    if isinstance(recording, Pair):
        raise InvalidArgument("path", "a sequence or a recording", "a pair of frames")
    chosen = chosen_frames(frames, len(recording))
    if sensor is not None and sensor.occlude and not any(map(sensor.occludes, chosen)):
        window = "{}:{}".format(*sensor.occlude)
        raise InvalidArgument("occlude", f"some of the frames {chosen[0]} to {chosen[-1]}", window)
    if isinstance(recording, Sequence):
        if template is not None:
            raise InvalidArgument("template", "none for a sequence, which has its own", str(template))
        return SequenceSource(recording, sensor or Sensor(), chosen, start, give_body, seed)
    if give_body:
        raise InvalidArgument("body", "a sequence with body_V and body_F", "a recording")
    if template is not None:
        mesh, vertex_map = repaired_mesh(template, unit)
    else:
        mesh, vertex_map = None, recording.repaired(chosen[0])[1] if isinstance(recording, FolderRecording) else None
    plain = sensor or replace(Sensor(), points=10**9, noise=0.0)
    return RecordingSource(recording, plain, chosen, mesh, seed, vertex_map)


def _displaced(vertices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(V, 3) vertices turned about the vertical through their middle and moved horizontally, at random."""
    turn = rotation_matrices([0.0, rng.uniform(-DISPLACED_TURN, DISPLACED_TURN), 0.0])
    middle = vertices.mean(axis=0)
    return (vertices - middle) @ turn.T + middle + rng.uniform(-DISPLACED_SHIFT, DISPLACED_SHIFT, 3) * [1, 0, 1]


def chosen_frames(text: str, count: int) -> range:
    """The frames of ``A:B`` among ``count``; negative ones from the end.

    Raises:
        InvalidArgument: not of that form, beyond the last frame, or fewer than two frames.
    """
    first, colon, last = text.partition(":")
    try:
        chosen = range(count)[int(first) if first else None : int(last) if last else None]
    except ValueError:
        chosen = range(0)
    else:
        if last and int(last) > count:
            raise InvalidArgument("frames", f"at most :{count}, the frames of the recording", repr(text))
    if not colon or len(chosen) < 2:
        raise InvalidArgument("frames", f"A:B with at least two of the {count} frames", repr(text))
    return chosen

"""Simulated recording: a cut garment, a motion, the settled and simulated cloth, and its measured quality."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from ddakf.data.body import Body, Pose, load_body
from ddakf.data.body_shape import random_shape, shaped
from ddakf.data.pack import DEFAULT_QUANTUM, packed
from ddakf.errors import InvalidArgument, PoorQuality
from ddakf.evaluation.simulation import fabrics, garments, motions, quality, solver
from ddakf.evaluation.simulation.garments import Garment
from ddakf.files.sequence import Sequence

SETTLING = 0.8  # s in the rest pose before the first frame
LICENCE = "CC0 1.0: body by MakeHuman (CC0), garment, motion and simulation by ddakf"
FEWEST_FRAMES, MOST_FRAMES = 2, 10_000  # allowed range: one step at least, and memory


KNOWN = {"garment": garments.GARMENTS, "motion": motions.MOTIONS, "fit": garments.FITS, "fabric": fabrics.FABRICS}


@dataclass(frozen=True)
class Order:
    """Parameters of a simulated recording.

    Attributes:
        garment: of :data:`garments.GARMENTS`.
        motion: of :data:`motions.MOTIONS`.
        n_frames: of the recording.
        n_vertices: of the garment, approximately.
        fps: frames per second.
        seed: varies the garment's measures and the motion; 0 leaves both unchanged.
        fit: of :data:`garments.FITS`.
        fabric: of :data:`fabrics.FABRICS`.
        body: seed of the body's shape; 0 for the body that ships.
        substeps: of a frame.
    """

    garment: str
    motion: str
    n_frames: int = 150
    n_vertices: int = 2700
    fps: float = 30.0
    seed: int = 0
    fit: str = "regular"
    fabric: str = "cotton"
    body: int = 0
    substeps: int = solver.DEFAULT_STEPS.substeps

    def __post_init__(self) -> None:
        for field, known in KNOWN.items():
            if (value := getattr(self, field)) not in known:
                raise InvalidArgument(field, f"one of {', '.join(known)}", value)
        for field in ("seed", "body"):
            if (value := getattr(self, field)) < 0:
                raise InvalidArgument(field, "a number from 0", str(value))
        if not FEWEST_FRAMES <= self.n_frames <= MOST_FRAMES:
            raise InvalidArgument("frames", f"a number in [{FEWEST_FRAMES}, {MOST_FRAMES}]", str(self.n_frames))
        if not 10 <= self.fps <= 240:
            raise InvalidArgument("fps", "frames per second in [10, 240]", f"{self.fps:g}")

    @property
    def n_settling(self) -> int:
        """Number of simulated frames in the rest pose, which are discarded."""
        return round(SETTLING * self.fps)


def record(order: Order, progress: Callable[[int, int, str], None] = lambda done, total, what: None) -> tuple[Sequence, Pose]:
    """Simulates a recording.

    Args:
        order: parameters of the recording.
        progress: called as ``progress(done, total, what)`` with frames, those of settling among them.

    Returns:
        The recording, and the pose of the body in each of its frames.

    Raises:
        MissingDependency: Newton is not installed.
        InvalidArgument: a number of vertices out of range.
        PoorQuality: the solver diverged.
    """
    body, total = shaped(load_body(), random_shape(order.body)), order.n_settling + order.n_frames - 1
    progress(0, total, "cutting the garment")
    garment = garments.make(order.garment, body, order.n_vertices, order.seed, order.fit)
    pose = motions.make(order.motion, body, order.n_frames, order.fps, order.seed)
    pose = Pose(pose.rotations.astype(np.float32), pose.shift.astype(np.float32))  # as stored: the body follows from it exactly
    frame_numbers = np.concatenate([np.zeros(order.n_settling, int), np.arange(order.n_frames)])
    posed = body.skinned(pose)[frame_numbers]
    pins = body.skinned(pose, body.attach(garment.mesh.vertices, garment.mesh.faces))[frame_numbers]
    progress(0, total, "compiling")
    frames = [garment.mesh.vertices.astype(np.float32)]
    material = fabrics.FABRICS[order.fabric], solver.Steps(order.substeps)
    for done, vertices in enumerate(solver.simulate(garment, posed, body.faces, pins, order.fps, *material), start=1):
        if not np.isfinite(vertices).all():
            raise PoorQuality(f"the solver diverged: coordinates of frame {done} of {total} are not finite")
        frames.append(vertices)
        progress(done, total, "settling" if done <= order.n_settling else "simulating")
    return _sequence(order, garment, np.array(frames[-order.n_frames :]), body, posed[-order.n_frames :]), pose


def _sequence(order: Order, garment: Garment, frames: np.ndarray, body: Body, posed: np.ndarray) -> Sequence:
    name = f"{order.garment}_{order.motion}"
    rest = garment.mesh.vertices.astype(np.float32)
    faces = garment.mesh.faces
    return Sequence(name, frames, faces, order.fps, rest, posed, body.faces, order.garment, order.motion)


def write(target: Path, order: Order, sequence: Sequence, pose: Pose, solver_version: str) -> dict:
    """Writes a recording of sufficient quality, and its quality figures into a ``.json`` of the same name beside it.

    Args:
        target: ends in ``.npz``.
        order, sequence, pose: the parameters, and the results of :func:`record`.
        solver_version: Newton's, for the note.

    Returns:
        The figures.

    Raises:
        PoorQuality: a figure is beyond its limit; nothing is written.
    """
    found = quality.figures(sequence)
    quality.check(found)
    part = target.with_name(target.stem + ".part.npz")
    np.savez_compressed(part, **arrays(order, sequence, pose))
    part.replace(target)
    note = asdict(order) | {
        "solver": f"Newton {solver_version}, vertex block descent",
        "material": asdict(fabrics.FABRICS[order.fabric]),
        "licence": LICENCE,
        "quality": found,
    }
    target.with_suffix(".json").write_text(json.dumps(note, indent=1) + "\n")
    return found


def arrays(order: Order, sequence: Sequence, pose: Pose, quantum: float = DEFAULT_QUANTUM) -> dict[str, np.ndarray]:
    """What a packed file of a recording holds: the garment, and the shape and poses of the body instead of its vertices."""
    garment = packed(replace(sequence, body_vertices=None, body_faces=None), quantum)
    shape = {"body_shape": random_shape(order.body).to_array()} if order.body else {}
    return garment | {"body_rotations": pose.rotations, "body_shift": pose.shift} | shape

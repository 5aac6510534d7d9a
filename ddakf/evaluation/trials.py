"""Accuracy, one trial at a time: a recording, a view, a variant of the method; in numbers, frame by frame and summed up.

A trial is fully described by its :class:`Trial`: the same trial gives the same clouds and, up to its times, the same row on
one machine. ``benchmarks/accuracy.py`` runs grids of them.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ddakf import data
from ddakf.errors import InvalidArgument, NotApplicable
from ddakf.evaluation import methods, metrics
from ddakf.evaluation.datasets import Pair, Recording, load_faust, open_dataset
from ddakf.evaluation.degradations import CLEAN, DISTURBANCES, Script
from ddakf.evaluation.protocols import scored
from ddakf.evaluation.records import Record, short
from ddakf.evaluation.sensed import STEPS, pair_row, recording_row
from ddakf.evaluation.sensors import Cloud, Sensor
from ddakf.evaluation.source import Frame
from ddakf.files.sequence import Sequence, load_sequence
from ddakf.mesh import Mesh

FAUST = "faust_"  # before the name of a clip
SAMPLE = "sample"  # the name of the recording that ships with the project
OFFSET, TURN = 0.10, np.radians(20)  # m, rad: how far off a trial of the start begins
CONVERGED, START_FRAMES = 1.2, 20  # times the error of the run from the truth; frames that such a trial lasts
RECOVERED, FRAMES_AFTER = 1.5, 20  # times the error of the undisturbed run; frames that are tracked after a disturbance


@dataclass(frozen=True)
class Trial:
    """One run. Flat, as the row that it is the key of: a sensor's settings are repeated here rather than held, since rows that
    are kept name them so, and a row without some of them is of their defaults then.

    Attributes:
        sequence: ``sample`` or another one that ships (``skirt_walk``), the name of a recording under DDAKF_DATA (``faust_s3_p7``
            of FAUST's clips), or a path.
        view: of :class:`ddakf.evaluation.sensors.Sensor`.
        body: the tracker is told the body of every frame.
        seed: of the sensor's noise.
        variant: see :func:`ddakf.evaluation.methods.named`.
        frames: tracked at most; None for all.
        first: frame at which the garment is known.
        segmented: only the garment's points.
        points: per cloud at most.
        noise: standard deviation, metres.
        start: number of a random start off the truth, see :func:`astray`; None starts at the truth.
        disturbance: name of one of :data:`ddakf.evaluation.degradations.DISTURBANCES`, or None.
        drop, outliers, depth_noise, depth_step, fliers, occlude, occluded, every: of :class:`ddakf.evaluation.sensors.Sensor`.
        surfaces: distances between the surfaces and silhouettes are measured as well; they take longer than a frame.
    """

    sequence: str
    view: str = "full"
    body: bool = False
    seed: int = 1
    variant: str = "default"
    frames: int | None = None
    first: int = 0
    segmented: bool = True
    points: int = 10_000
    noise: float = 0.003
    start: int | None = None
    disturbance: str | None = None
    drop: float = 0.0
    outliers: float = 0.0
    depth_noise: float = 0.0
    depth_step: float = 0.0
    fliers: float = 0.0
    occlude: tuple[int, int] | None = None
    occluded: float = 0.4
    every: int = 1
    surfaces: bool = False

    @classmethod
    def of(cls, row: dict) -> Trial:
        """The trial of a row; fields that the row does not know have their defaults."""
        known = {field.name: row[field.name] for field in fields(cls) if field.name in row}
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in known.items()})


# Recordings ---------------------------------------------------------------------------------------------------------


def names() -> list[str]:
    """The bundled sample, and the recordings under DDAKF_DATA."""
    folder = _folder()
    return [SAMPLE, *(sorted(path.stem for path in folder.glob("*.npz")) if folder else [])]


@lru_cache(maxsize=8)
def recording(name: str) -> Sequence | Recording | Pair:
    """A recording by its name, or what is at a path, see :func:`ddakf.evaluation.datasets.open_dataset`.

    Raises:
        InvalidArgument: neither a name that is known nor a path.
        InvalidFile: nothing that can be read is at the path.
    """
    if name == SAMPLE:
        return data.sample()
    if name.startswith(FAUST) and (archive := _faust()):
        return load_faust(archive).clip(name.removeprefix(FAUST))
    for place in (name, *_under_data(name)):
        if Path(place.partition("#")[0]).exists():
            return open_dataset(place)
    if name in {path.stem for path in data.TRAINING.glob("*.npz")}:
        return load_sequence(data.TRAINING / f"{name}.npz")
    folder = _folder()
    if folder is None or not (folder / f"{name}.npz").is_file():
        known = [*names(), *sorted(path.stem for path in data.TRAINING.glob("*.npz"))]
        raise InvalidArgument("sequence", f"a path, or one of {', '.join(known)} (DDAKF_DATA names a folder of more)", repr(name))
    return load_sequence(folder / f"{name}.npz")


def faust_names() -> list[str]:
    """The clips of FAUST under DDAKF_DATA, as :func:`recording` knows them."""
    archive = _faust()
    return [FAUST + clip for clip in load_faust(archive).clips] if archive else []


def sensed_names() -> tuple[list[str], list[str]]:
    """Depth recordings without truth, and pairs with scene flow: paths relative to DDAKF_DATA, the same on every machine."""
    root = Path(os.environ.get("DDAKF_DATA") or os.devnull)
    depth = sorted(root.glob("depth/utd-mhad/*_depth.mat"))
    pairs = sorted(path for path in root.glob("depth/deepdeform/*") if path.is_dir())
    return [path.relative_to(root).as_posix() for path in depth], [path.relative_to(root).as_posix() for path in pairs]


def _under_data(name: str) -> list[str]:
    root = os.environ.get("DDAKF_DATA")
    return [str(Path(root, name))] if root else []


def _faust() -> Path | None:
    root = os.environ.get("DDAKF_DATA")
    return next(iter(sorted(Path(root, "faust").glob("*.npz"))), None) if root else None


def _folder() -> Path | None:
    root = os.environ.get("DDAKF_DATA")
    return Path(root, "sequences") if root else None


@lru_cache(maxsize=256)
def _cloud(name: str, frame: int, seed: int, sensor: Sensor) -> Cloud:
    return sensor.capture(recording(name), frame, np.random.default_rng([seed, frame]))


def tracked(trial: Trial) -> range:
    """The frames that a trial tracks, by their number in the recording."""
    known = recording(trial.sequence)
    if isinstance(known, Pair):
        return range(1, STEPS + 1)
    last = len(known) - 1
    if trial.frames is not None:
        last = min(trial.first + trial.frames * trial.every, last)
    return range(trial.first + trial.every, last + 1, trial.every)


def astray(rest: np.ndarray, truth: np.ndarray, number: int) -> np.ndarray:
    """The template in its rest shape, laid onto the truth rigidly, then turned by 20 degrees about the vertical through its
    centroid, to a random side, and moved by 10 cm in a random horizontal direction.

    Args:
        rest, truth: (V, 3) metres, y up.
        number: of the random start.
    """
    rng = np.random.default_rng([number, 20])
    rest, truth = np.asarray(rest, np.float64), np.asarray(truth, np.float64)
    centred, centre = rest - rest.mean(axis=0), truth.mean(axis=0)
    u, _, vt = np.linalg.svd((truth - centre).T @ centred)
    u[:, 2] *= np.linalg.det(u @ vt)
    angle, heading = TURN * rng.choice([-1, 1]), rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return centred @ (turn @ u @ vt).T + centre + OFFSET * np.array([np.cos(heading), 0, np.sin(heading)])


# A run --------------------------------------------------------------------------------------------------------------


def run(trial: Trial) -> dict:
    """Runs a trial.

    Returns:
        The trial's fields, and what :meth:`Record.summary` gives; with a start off the truth or a disturbance also
        ``reference_rmse_mm`` and ``reference_normal_rmse_mm``, per frame, of the run from the truth or the undisturbed one,
        and ``frames_until_rmse_mm`` and ``frames_until_normal_rmse_mm``, after which the error was within
        :data:`CONVERGED` or :data:`RECOVERED` times that, None for never. Where the method could not go on, ``failed`` with
        its sentence; where it does not apply, ``not_applicable`` with its own.

    Raises:
        InvalidArgument: no such variant, view, disturbance or recording.
    """
    methods.named(trial.variant)
    for check in (sensor_of, _script, tracked):
        check(trial)
    try:
        match recording(trial.sequence):
            case Sequence():
                return asdict(trial) | _outcome(trial)
            case Pair() as pair:
                return asdict(trial) | pair_row(_maker(trial), pair)
            case other:
                return asdict(trial) | recording_row(_maker(trial), other, tracked(trial), sensor_of(trial), trial.seed)
    except NotApplicable as reason:
        return asdict(trial) | {"not_applicable": str(reason)}
    except Exception as error:  # whatever it is: a study's other methods go on, and its result says what happened
        return asdict(trial) | {"failed": f"{type(error).__name__}: {error}"}


def _maker(trial: Trial) -> methods.Maker:
    """Of the method, on what has no body that it could be told."""
    if trial.body:
        raise NotApplicable(f"{trial.sequence} has no body that a method could be told")
    return methods.named(trial.variant, scored(Path(trial.sequence).stem))


def _outcome(trial: Trial) -> dict:
    if trial.start is not None:
        trial = replace(trial, frames=trial.frames or START_FRAMES)
        return _compared(_track(trial), _reference(replace(trial, start=None)), CONVERGED)
    if trial.disturbance is not None:
        last = _script(trial).events[-1].last
        trial = replace(trial, frames=trial.frames or last + FRAMES_AFTER)
        return _compared(_track(trial), _reference(replace(trial, disturbance=None)), RECOVERED, after=trial.first + last)
    return _track(trial).summary()


def _compared(record: Record, reference: Record, factor: float, after: int = -1) -> dict:
    """A run's summary, and how long after frame number ``after`` its errors came within those of another."""
    place = {number: k for k, number in enumerate(reference.numbers)}
    compared = {}
    for name in ("rmse_mm", "normal_rmse_mm"):
        other = [reference.frames[name][place[number]] for number in record.numbers]
        compared[f"reference_{name}"] = short(other)
        pairs = [(e, r) for n, e, r in zip(record.numbers, record.frames[name], other, strict=True) if n > after]
        compared[f"frames_until_{name}"] = metrics.frames_until_within(*np.array(pairs).reshape(-1, 2).T, factor)
    return record.summary() | compared


def sensor_of(trial: Trial) -> Sensor:
    return Sensor(**{field.name: getattr(trial, field.name) for field in fields(Sensor)})


def _script(trial: Trial) -> Script:
    known = {script.name: script for script in DISTURBANCES} | {None: CLEAN}
    if trial.disturbance not in known:
        raise InvalidArgument("disturbance", f"one of {', '.join(filter(None, known))}", repr(trial.disturbance))
    return known[trial.disturbance]


def _frames(trial: Trial) -> Iterator[Frame]:
    """What arrives."""
    sequence, sensor = recording(trial.sequence), sensor_of(trial)

    def undisturbed() -> Iterator[Frame]:
        for number in tracked(trial):
            points, origin = _cloud(trial.sequence, number, trial.seed, sensor)
            body = sequence.body_vertices[number] if trial.body else None
            yield Frame(number, sequence.timestamp(number), points, origin, body)

    return (frame for frame, _ in _script(trial).apply(undisturbed(), trial.seed))


def estimate(trial: Trial, number: int) -> np.ndarray:
    """(V, 3) metres, what a trial's method says about a frame of the recording.

    Raises:
        InvalidArgument: the trial does not track it. Whatever the method raises.
    """
    if number not in tracked(trial):
        raise InvalidArgument("frame", f"one of {tracked(trial)}", str(number))
    step = _started(trial)
    for frame in _frames(trial):
        vertices = step(frame).vertices
        if frame.number == number:
            break
    return vertices


def _started(trial: Trial) -> methods.Method:
    sequence = recording(trial.sequence)
    truth = sequence.garment_vertices[trial.first].astype(np.float64)
    start = truth if trial.start is None else astray(sequence.template, truth, trial.start)
    if trial.body and not sequence.has_body:
        raise NotApplicable(f"{sequence.name} has no body that a method could be told")
    body = Mesh(sequence.body_vertices[trial.first], sequence.body_faces) if trial.body else None
    return methods.named(trial.variant, scored(sequence))(Mesh(sequence.template, sequence.garment_faces), start, body)


def _track(trial: Trial) -> Record:
    sequence, step = recording(trial.sequence), _started(trial)
    record = Record(Mesh(sequence.template, sequence.garment_faces), sequence, surfaces=trial.surfaces)
    for frame in _frames(trial):
        wall, cpu = time.perf_counter(), time.thread_time()
        estimate = step(frame)
        record.add(frame.number, estimate, time.thread_time() - cpu, time.perf_counter() - wall)
    if trial.surfaces:
        record.memory_mib = _memory(step, replace(frame, timestamp=frame.timestamp + trial.every / sequence.fps))
    return record


def _memory(step: methods.Method, frame: Frame) -> float | None:
    """MiB that one more frame takes at most, beyond what was resident before it."""
    peak = metrics.ResidentPeak()
    step(frame)
    return peak.mib()


@lru_cache(maxsize=2)
def _reference(trial: Trial) -> Record:
    """What several trials in a row are compared with."""
    return _track(trial)

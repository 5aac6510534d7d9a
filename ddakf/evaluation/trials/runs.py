"""Accuracy, one trial at a time: a recording, a view, a variant of the method; in numbers, frame by frame and summed up.

A trial is fully described by its :class:`Trial`: the same trial gives the same clouds and, up to its times, the same row on
one machine. ``benchmarks/accuracy.py`` runs grids of them.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidArgument, NotApplicable
from ddakf.evaluation import metrics
from ddakf.evaluation.datasets import Pair
from ddakf.evaluation.sensors.captured_frame import CapturedFrame, Cloud
from ddakf.evaluation.sensors.degradations import CLEAN, DISTURBANCES, Script
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.splits import labels_of
from ddakf.evaluation.trials import methods
from ddakf.evaluation.trials.estimates import Method, MethodFactory
from ddakf.evaluation.trials.recorded_runs import pair_row, recording_row
from ddakf.evaluation.trials.recordings import find_recording, tracked_frames
from ddakf.evaluation.trials.run_score import RunScore, json_numbers
from ddakf.evaluation.trials.trial import Trial, sensor_of
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh

OFFSET, TURN = 0.10, np.radians(20)  # m, rad: how far off a trial of the start begins
CONVERGED, START_FRAMES = 1.2, 20  # times the error of the run from the truth; frames that such a trial lasts
RECOVERED, FRAMES_AFTER = 1.5, 20  # times the error of the undisturbed run; frames that are tracked after a disturbance


# Recordings ---------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=256)
def _cloud(name: str, frame: int, seed: int, sensor: Sensor) -> Cloud:
    return sensor.capture(find_recording(name), frame, np.random.default_rng([seed, frame]))


def displaced_template(rest: np.ndarray, truth: np.ndarray, number: int) -> np.ndarray:
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


def run_trial(trial: Trial) -> dict:
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
    methods.method_factory(trial.variant)
    for check in (sensor_of, _script, tracked_frames):
        check(trial)
    try:
        match find_recording(trial.sequence):
            case Sequence():
                return asdict(trial) | _outcome(trial)
            case Pair() as pair:
                return asdict(trial) | pair_row(_maker(trial), pair)
            case other:
                return asdict(trial) | recording_row(_maker(trial), other, tracked_frames(trial), sensor_of(trial), trial.seed)
    except NotApplicable as reason:
        return asdict(trial) | {"not_applicable": str(reason)}
    except Exception as error:  # whatever it is: a study's other methods go on, and its result says what happened
        return asdict(trial) | {"failed": f"{type(error).__name__}: {error}"}


def _maker(trial: Trial) -> MethodFactory:
    """Of the method, on what has no body that it could be told."""
    if trial.body:
        raise NotApplicable(f"{trial.sequence} has no body that a method could be told")
    return methods.method_factory(trial.variant, labels_of(Path(trial.sequence).stem))


def _outcome(trial: Trial) -> dict:
    if trial.start is not None:
        trial = replace(trial, frames=trial.frames or START_FRAMES)
        return _compared(_track(trial), _reference(replace(trial, start=None)), CONVERGED)
    if trial.disturbance is not None:
        last = _script(trial).events[-1].last
        trial = replace(trial, frames=trial.frames or last + FRAMES_AFTER)
        return _compared(_track(trial), _reference(replace(trial, disturbance=None)), RECOVERED, after=trial.first + last)
    return _track(trial).summary()


def _compared(record: RunScore, reference: RunScore, factor: float, after: int = -1) -> dict:
    """A run's summary, and how long after frame number ``after`` its errors came within those of another."""
    place = {number: k for k, number in enumerate(reference.numbers)}
    compared = {}
    for name in ("rmse_mm", "normal_rmse_mm"):
        other = [reference.frames[name][place[number]] for number in record.numbers]
        compared[f"reference_{name}"] = json_numbers(other)
        pairs = [(e, r) for n, e, r in zip(record.numbers, record.frames[name], other, strict=True) if n > after]
        compared[f"frames_until_{name}"] = metrics.frames_until_within(*np.array(pairs).reshape(-1, 2).T, factor)
    return record.summary() | compared


def _script(trial: Trial) -> Script:
    known = {script.name: script for script in DISTURBANCES} | {None: CLEAN}
    if trial.disturbance not in known:
        raise InvalidArgument("disturbance", f"one of {', '.join(filter(None, known))}", repr(trial.disturbance))
    return known[trial.disturbance]


def _frames(trial: Trial) -> Iterator[CapturedFrame]:
    """What arrives."""
    sequence, sensor = find_recording(trial.sequence), sensor_of(trial)

    def undisturbed() -> Iterator[CapturedFrame]:
        for number in tracked_frames(trial):
            points, origin = _cloud(trial.sequence, number, trial.seed, sensor)
            body = sequence.body_vertices[number] if trial.body else None
            yield CapturedFrame(number, sequence.timestamp(number), points, origin, body)

    return (frame for frame, _ in _script(trial).apply(undisturbed(), trial.seed))


def estimate_frame(trial: Trial, number: int) -> np.ndarray:
    """(V, 3) metres, what a trial's method says about a frame of the recording.

    Raises:
        InvalidArgument: the trial does not track it. Whatever the method raises.
    """
    if number not in tracked_frames(trial):
        raise InvalidArgument("frame", f"one of {tracked_frames(trial)}", str(number))
    step = _started(trial)
    for frame in _frames(trial):
        vertices = step(frame).vertices
        if frame.number == number:
            break
    return vertices


def _started(trial: Trial) -> Method:
    sequence = find_recording(trial.sequence)
    truth = sequence.garment_vertices[trial.first].astype(np.float64)
    start = truth if trial.start is None else displaced_template(sequence.template, truth, trial.start)
    if trial.body and not sequence.has_body:
        raise NotApplicable(f"{sequence.name} has no body that a method could be told")
    body = Mesh(sequence.body_vertices[trial.first], sequence.body_faces) if trial.body else None
    garment = Mesh(sequence.template, sequence.garment_faces)
    return methods.method_factory(trial.variant, labels_of(sequence))(garment, start, body)


def _track(trial: Trial) -> RunScore:
    sequence, step = find_recording(trial.sequence), _started(trial)
    record = RunScore(Mesh(sequence.template, sequence.garment_faces), sequence, surfaces=trial.surfaces)
    for frame in _frames(trial):
        wall, cpu = time.perf_counter(), time.thread_time()
        estimate = step(frame)
        record.add(frame.number, estimate, time.thread_time() - cpu, time.perf_counter() - wall)
    if trial.surfaces:
        record.memory_mib = _memory(step, replace(frame, timestamp=frame.timestamp + trial.every / sequence.fps))
    return record


def _memory(step: Method, frame: CapturedFrame) -> float | None:
    """MiB that one more frame takes at most, beyond what was resident before it."""
    peak = metrics.ResidentPeak()
    step(frame)
    return peak.mib()


@lru_cache(maxsize=2)
def _reference(trial: Trial) -> RunScore:
    """What several trials in a row are compared with."""
    return _track(trial)

"""Runs of trials: each tracks a recording with a method, and returns a row of numbers.

The same :class:`ddakf.evaluation.trials.trial.Trial` gives the same clouds and, up to its times, the same row on one machine.
``benchmarks/accuracy.py`` runs grids of them.
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
    """The template in its rest shape, aligned rigidly with the truth, then turned by 20 degrees about the vertical through its
    centroid, to a random side, and moved by 10 cm in a random horizontal direction.

    Args:
        rest, truth: (V, 3) metres, y up.
        number: of the random start.
    """
    rng = np.random.default_rng([number, 20, 1])  # clouds have [seed, frame]
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
        The trial's fields and those of :meth:`RunScore.summary`. With a displaced start or a disturbance also
        ``reference_rmse_mm`` and ``reference_normal_rmse_mm``, per frame, of the run from the truth or the undisturbed one, and
        ``frames_until_rmse_mm`` and ``frames_until_normal_rmse_mm``: frames until the error is within :data:`CONVERGED` or
        :data:`RECOVERED` times that, None for never. If the method fails, ``failed`` with the error; if it does not apply,
        ``not_applicable`` with the reason.

    Raises:
        InvalidArgument: no such variant, view, disturbance or recording.
    """
    methods.method_factory(trial.variant)
    for check in (sensor_of, _script, tracked_frames):
        check(trial)
    begun = time.perf_counter()
    return _row(trial) | {"seconds": round(time.perf_counter() - begun, 2)}


def _row(trial: Trial) -> dict:
    try:
        match find_recording(trial.sequence):
            case Sequence():
                return asdict(trial) | _sequence_row(trial)
            case Pair() as pair:
                return asdict(trial) | pair_row(_factory_without_body(trial), pair)
            case other:
                factory, sensor = _factory_without_body(trial), sensor_of(trial)
                return asdict(trial) | recording_row(factory, other, tracked_frames(trial), sensor, trial.seed)
    except NotApplicable as reason:
        return asdict(trial) | {"not_applicable": str(reason)}
    except Exception as error:  # any error: the study's other methods go on, and its result reports it
        return asdict(trial) | {"failed": f"{type(error).__name__}: {error}"}


def _factory_without_body(trial: Trial) -> MethodFactory:
    """The method's factory, for a recording without a body."""
    if trial.body:
        raise NotApplicable(f"{trial.sequence} has no body that a method could be told")
    return methods.method_factory(trial.variant, labels_of(Path(trial.sequence).stem))


def _sequence_row(trial: Trial) -> dict:
    if trial.start is not None:
        trial = replace(trial, frames=trial.frames or START_FRAMES)
        return _compared_summary(_track(trial), _reference(replace(trial, start=None)), CONVERGED)
    if trial.disturbance is not None:
        last = _script(trial).events[-1].last
        trial = replace(trial, frames=trial.frames or last + FRAMES_AFTER)
        return _compared_summary(_track(trial), _reference(replace(trial, disturbance=None)), RECOVERED, after=trial.first + last)
    return _track(trial).summary()


def _compared_summary(record: RunScore, reference: RunScore, factor: float, after: int = -1) -> dict:
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
    """The frames that arrive, after the trial's disturbance."""
    sequence, sensor = find_recording(trial.sequence), sensor_of(trial)

    def undisturbed() -> Iterator[CapturedFrame]:
        for number in tracked_frames(trial):
            points, origin = _cloud(trial.sequence, number, trial.seed, sensor)
            body = sequence.body_vertices[number] if trial.body else None
            yield CapturedFrame(number, sequence.timestamp(number), points, origin, body).copy()

    return (frame for frame, _ in _script(trial).apply(undisturbed(), trial.seed))


def estimate_frame(trial: Trial, number: int) -> np.ndarray:
    """(V, 3) metres, the estimate of a trial's method for a frame of the recording.

    Raises:
        InvalidArgument: the trial does not track the frame. Any error of the method.
    """
    if number not in tracked_frames(trial):
        raise InvalidArgument("frame", f"one of {tracked_frames(trial)}", str(number))
    step = _started_method(trial)
    for frame in _frames(trial):
        vertices = step(frame).vertices
        if frame.number == number:
            break
    return vertices


def _started_method(trial: Trial) -> Method:
    sequence = find_recording(trial.sequence)
    truth = sequence.garment_vertices[trial.first].astype(np.float64)
    start = truth if trial.start is None else displaced_template(sequence.template, truth, trial.start)
    if trial.body and not sequence.has_body:
        raise NotApplicable(f"{sequence.name} has no body that a method could be told")
    body = Mesh(sequence.body_vertices[trial.first], sequence.body_faces) if trial.body else None
    garment = Mesh(sequence.template, sequence.garment_faces)
    return methods.method_factory(trial.variant, labels_of(sequence))(garment, start, body)


def _track(trial: Trial) -> RunScore:
    sequence, step = find_recording(trial.sequence), _started_method(trial)
    record = RunScore(Mesh(sequence.template, sequence.garment_faces), sequence, surfaces=trial.surfaces)
    for frame in _frames(trial):
        wall, cpu = time.perf_counter(), time.process_time()
        estimate = step(frame)
        record.add(frame.number, estimate, time.process_time() - cpu, time.perf_counter() - wall)
    if trial.surfaces:
        record.memory_mib = _memory(step, replace(frame, timestamp=frame.timestamp + trial.every / sequence.fps))
    return record


def _memory(step: Method, frame: CapturedFrame) -> float | None:
    """Peak memory of one more frame, MiB, beyond the resident memory before it."""
    peak = metrics.ResidentPeak()
    step(frame)
    return peak.mib()


@lru_cache(maxsize=2)
def _reference(trial: Trial) -> RunScore:
    """The reference run, cached because several consecutive trials have the same one."""
    return _track(trial)

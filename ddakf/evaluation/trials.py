"""Accuracy, one trial at a time: a recording, a view, a variant of the method; in numbers, frame by frame and summed up.

A trial is fully described by its :class:`Trial`: the same trial gives the same clouds and, up to its times, the same row on
one machine. ``benchmarks/accuracy.py`` runs grids of them.
"""

from __future__ import annotations

import json
import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddakf import data
from ddakf.config import Config
from ddakf.errors import DdakfError, InvalidArgument
from ddakf.evaluation import metrics
from ddakf.evaluation.baselines import BASELINES, baseline
from ddakf.evaluation.degradations import CLEAN, DISTURBANCES, Script
from ddakf.evaluation.sensors import Cloud, Sensor
from ddakf.evaluation.source import Frame
from ddakf.mesh import Mesh
from ddakf.sequence import Sequence, load_sequence
from ddakf.tracker import Tracker

SAMPLE = "sample"  # the name of the recording that ships with the project
FIRST_FRAMES, LAST_FRAMES = 59, 10  # tracked frames that the means "first60" (frame 0 is given) and "last10" are over
NOMINAL = tuple(round(0.05 * k, 2) for k in range(1, 20)) + (0.99,)  # probabilities of the reliability diagram
OFFSET, TURN = 0.10, np.radians(20)  # m, rad: how far off a trial of the start begins
CONVERGED, START_FRAMES = 1.2, 20  # times the error of the run from the truth; frames that such a trial lasts
RECOVERED, FRAMES_AFTER = 1.5, 20  # times the error of the undisturbed run; frames that are tracked after a disturbance


@dataclass(frozen=True)
class Trial:
    """One run.

    Attributes:
        sequence: ``sample``, or the name of a recording in the folder ``sequences`` of DDAKF_DATA.
        view: of :class:`ddakf.evaluation.sensors.Sensor`.
        body: the tracker is told the body of every frame.
        seed: of the sensor's noise.
        variant: see :func:`configuration`, or the name of a baseline.
        frames: tracked at most; None for all.
        first: frame at which the garment is known.
        segmented: only the garment's points.
        points: per cloud at most.
        noise: standard deviation, metres.
        start: number of a random start off the truth, see :func:`astray`; None starts at the truth.
        disturbance: name of one of :data:`ddakf.evaluation.degradations.DISTURBANCES`, or None.
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

    @classmethod
    def of(cls, row: dict) -> Trial:
        """The trial of a row; fields that the row does not know have their defaults."""
        return cls(**{field.name: row[field.name] for field in fields(cls) if field.name in row})


class Estimate(NamedTuple):
    """What a method says about one frame; the fields after the first are None where it says nothing about them."""

    vertices: np.ndarray  # (V, 3) m
    covariance: np.ndarray | None = None  # (V, 3, 3) m^2
    observed: np.ndarray | None = None  # (V,) bool
    reliability: float | None = None
    paper_score: float | None = None
    coverage: float | None = None
    state: str | None = None


Method = Callable[[Frame], Estimate]


# Methods ------------------------------------------------------------------------------------------------------------


def ablations() -> dict[str, Config]:
    """The default without each of its five changes to the paper's method, one at a time."""
    default = Config()
    association = default.associate
    blind = replace(association, facing_cosine=-1.0, normal_cosine=-1.0, hidden_depth=100.0)
    once = replace(association, iterations=1, least_iterations=1)
    alone = replace(default.physics, motion_rigidity=0.0, rest_rigidity=0.0, uneven_rigidity=0.0)
    return {
        "no-planes": replace(default, associate=replace(association, tangential_sd=default.adapt.initial_sd)),
        "one-association": replace(without_levels(), associate=once),
        "no-visibility": replace(default, associate=blind),
        "no-correlation": replace(default, physics=alone),
        "no-carrying": replace(default, predict=replace(default.predict, carry_reach=0.0)),
    }


def refinements() -> dict[str, Config]:
    """The default without each of what was added beyond the five changes, one at a time."""
    default = Config()
    return {
        "no-softening": replace(default, physics=replace(default.physics, strain_sd=1e3)),
        "no-levels": without_levels(),
        "no-hems": replace(default, associate=replace(default.associate, hem_reach=0.0)),
    }


def without_levels() -> Config:
    """The default with passes over all vertices only: neither rigid clusters nor coarser versions of the garment before."""
    default = Config()
    return replace(default, coarse=replace(default.coarse, iterations=0), pyramid=replace(default.pyramid, iterations=0))


def configuration(variant: str) -> Config:
    """The configuration of a variant: ``default``, ``paper``, one of :func:`ablations` or :func:`refinements`, or
    ``NAME={...}``, JSON of :meth:`ddakf.Config.from_dict` with a name for the tables.

    Raises:
        InvalidArgument: none of these.
    """
    name, _, values = variant.partition("=")
    if values:
        try:
            return Config.from_dict(json.loads(values))
        except json.JSONDecodeError as error:
            raise InvalidArgument("variant", "NAME={JSON}", f"{values!r} ({error})") from error
    known = {"default": Config(), "paper": Config.paper()} | ablations() | refinements()
    if name not in known:
        raise InvalidArgument("variant", f"one of {', '.join([*known, *BASELINES])}, or NAME={{JSON}}", repr(variant))
    return known[name]


def _tracker(config: Config, garment: Mesh, start: np.ndarray, body: Mesh | None) -> Method:
    tracker = Tracker(garment, body=body, config=config)
    tracker.reset(vertices=start)

    def step(frame: Frame) -> Estimate:
        r = tracker.step(
            frame.points,
            timestamp=frame.timestamp,
            sensor_origin=frame.sensor_origin,
            body_vertices=frame.body_vertices,
        )
        return Estimate(r.vertices, r.covariance, r.observed, r.reliability, r.paper_score, r.coverage, r.state)

    return step


def _baseline(name: str, garment: Mesh, start: np.ndarray, body: Mesh | None) -> Method:
    method = baseline(name)
    method.start(garment, start, body)

    def step(frame: Frame) -> Estimate:
        return Estimate(method.step(frame.points, frame.timestamp, frame.sensor_origin, frame.body_vertices))

    return step


# Recordings ---------------------------------------------------------------------------------------------------------


def names() -> list[str]:
    """The bundled sample, and the recordings under DDAKF_DATA."""
    folder = _folder()
    return [SAMPLE, *(sorted(path.stem for path in folder.glob("*.npz")) if folder else [])]


@lru_cache(maxsize=8)
def recording(name: str) -> Sequence:
    """A recording by its name.

    Raises:
        InvalidArgument: DDAKF_DATA does not hold it.
    """
    if name == SAMPLE:
        return data.sample()
    folder = _folder()
    if folder is None or not (folder / f"{name}.npz").is_file():
        raise InvalidArgument("sequence", f"one of {', '.join(names())} (DDAKF_DATA names the folder)", repr(name))
    return load_sequence(folder / f"{name}.npz")


def _folder() -> Path | None:
    root = os.environ.get("DDAKF_DATA")
    return Path(root, "sequences") if root else None


@lru_cache(maxsize=256)
def _cloud(name: str, frame: int, seed: int, sensor: Sensor) -> Cloud:
    return sensor.capture(recording(name), frame, np.random.default_rng([seed, frame]))


def _numbers(trial: Trial) -> range:
    """The frames that a trial tracks, by their number in the recording."""
    last = len(recording(trial.sequence)) - 1
    return range(trial.first + 1, last + 1 if trial.frames is None else min(trial.first + trial.frames, last) + 1)


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
        its sentence.

    Raises:
        InvalidArgument: no such variant, view, disturbance or recording.
    """
    for check in (_method, _sensor, _script, _numbers):
        check(trial)
    try:
        return asdict(trial) | _outcome(trial)
    except (DdakfError, ArithmeticError, np.linalg.LinAlgError) as error:
        return asdict(trial) | {"failed": f"{type(error).__name__}: {error}"}


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
        compared[f"reference_{name}"] = _short(other)
        pairs = [(e, r) for n, e, r in zip(record.numbers, record.frames[name], other, strict=True) if n > after]
        compared[f"frames_until_{name}"] = metrics.frames_until_within(*np.array(pairs).reshape(-1, 2).T, factor)
    return record.summary() | compared


def _sensor(trial: Trial) -> Sensor:
    return Sensor(trial.view, trial.points, trial.noise, segmented=trial.segmented)


def _script(trial: Trial) -> Script:
    known = {script.name: script for script in DISTURBANCES} | {None: CLEAN}
    if trial.disturbance not in known:
        raise InvalidArgument("disturbance", f"one of {', '.join(filter(None, known))}", repr(trial.disturbance))
    return known[trial.disturbance]


def _frames(trial: Trial) -> Iterator[Frame]:
    """What arrives."""
    sequence, sensor = recording(trial.sequence), _sensor(trial)

    def undisturbed() -> Iterator[Frame]:
        for number in _numbers(trial):
            points, origin = _cloud(trial.sequence, number, trial.seed, sensor)
            body = sequence.body_vertices[number] if trial.body else None
            yield Frame(number, sequence.timestamp(number), points, origin, body)

    return (frame for frame, _ in _script(trial).apply(undisturbed(), trial.seed))


def _method(trial: Trial):
    return partial(_baseline, trial.variant) if trial.variant in BASELINES else partial(_tracker, configuration(trial.variant))


def _track(trial: Trial) -> Record:
    sequence = recording(trial.sequence)
    garment = Mesh(sequence.template, sequence.garment_faces)
    truth = sequence.garment_vertices[trial.first].astype(np.float64)
    start = truth if trial.start is None else astray(sequence.template, truth, trial.start)
    body = Mesh(sequence.body_vertices[trial.first], sequence.body_faces) if trial.body else None
    step, record = _method(trial)(garment, start, body), Record(garment, sequence)
    for frame in _frames(trial):
        wall, cpu = time.perf_counter(), time.thread_time()
        estimate = step(frame)
        record.add(frame.number, estimate, time.thread_time() - cpu, time.perf_counter() - wall)
    return record


@lru_cache(maxsize=2)
def _reference(trial: Trial) -> Record:
    """What several trials in a row are compared with."""
    return _track(trial)


class Record:
    """What a run's frames are worth against the truth.

    Args:
        garment: the template.
        sequence: the truth.
    """

    def __init__(self, garment: Mesh, sequence: Sequence):
        self._garment, self._sequence, self._shape = garment, sequence, metrics.ShapeDifference(garment)
        has_body = sequence.has_body
        self._inside = metrics.Penetration(Mesh(sequence.body_vertices[0], sequence.body_faces)) if has_body else None
        self.numbers: list[int] = []
        self.frames: dict[str, list] = defaultdict(list)
        self._estimates: list[np.ndarray] = []
        self._groups = {name: Calibration() for name in ("observed", "hidden")}

    def add(self, number: int, estimate: Estimate, cpu_seconds: float, wall_seconds: float) -> None:
        """Takes in one frame.

        Args:
            number: of the frame in the recording.
            estimate: the method's.
            cpu_seconds: of this thread.
            wall_seconds: that went by.
        """
        truth, vertices = self._sequence.garment_vertices[number], np.asarray(estimate.vertices, np.float64)
        self.numbers.append(number)
        self._estimates.append(vertices.astype(np.float32))
        values = {
            "rmse_mm": metrics.rmse_mm(vertices, truth),
            "normal_rmse_mm": metrics.normal_rmse_mm(vertices, truth, self._garment.faces),
            "stretch_pct": self._shape.stretch(vertices, self._garment.vertices),
            "stretch_truth_pct": self._shape.stretch(truth, self._garment.vertices),
            "stretch_error_pct": self._shape.stretch(vertices, truth),
            "bend_deg": self._shape.bend(vertices, self._garment.vertices),
            "bend_truth_deg": self._shape.bend(truth, self._garment.vertices),
            "bend_error_deg": self._shape.bend(vertices, truth),
            "crossings": metrics.crossings(vertices, truth, self._garment),
            "cpu_ms": 1e3 * cpu_seconds,
            "wall_ms": 1e3 * wall_seconds,
        }
        if self._inside is not None:
            body = self._sequence.body_vertices[number]
            values["penetration_mm"], values["inside"] = self._inside(vertices, body)
            values["penetration_truth_mm"], _ = self._inside(truth, body)
        for name in ("reliability", "paper_score", "coverage", "state"):
            if getattr(estimate, name) is not None:
                values[name] = getattr(estimate, name)
        if estimate.covariance is not None:
            values |= self._calibration(vertices, truth, estimate)
        for name, value in values.items():
            self.frames[name].append(value)

    def _calibration(self, vertices: np.ndarray, truth: np.ndarray, estimate: Estimate) -> dict[str, float]:
        m = metrics.squared_mahalanobis(vertices, truth, estimate.covariance)
        nll = metrics.gaussian_nll(m, estimate.covariance)
        for name, group in zip(("observed", "hidden"), (estimate.observed, ~estimate.observed), strict=True):
            self._groups[name].add(vertices[group], truth[group], m[group], nll[group])
        sigma = np.sqrt(np.trace(estimate.covariance, axis1=1, axis2=2) / 3)
        error = np.linalg.norm(vertices - truth, axis=1)
        return {"spearman_sigma": metrics.spearman(sigma, error), "coverage90": metrics.coverage90(m)}

    def summary(self) -> dict:
        """The run in numbers, as JSON has them; None where nothing was measured. Keys end in their unit.

        Returns:
            ``frames_tracked``; means over frames of the per-frame values, those of the RMSE also over the first 60 and the
            last 10 frames; ``flicker_mm``; ``cpu_ms_p50``, ``cpu_ms_p99``, ``wall_ms_p50``, ``wall_ms_p99``; ``states``;
            ``observed`` and ``hidden``: see :meth:`Calibration.summary`; ``per_frame``: arrays.
        """
        per_frame = {name: values for name, values in self.frames.items() if name not in ("cpu_ms", "wall_ms", "state")}
        summary = {"frames_tracked": len(self.numbers)} | {name: _mean(values) for name, values in per_frame.items()}
        for name in ("rmse_mm", "normal_rmse_mm"):
            summary[f"{name}_first60"] = _mean(self.frames[name][:FIRST_FRAMES])
            summary[f"{name}_last10"] = _mean(self.frames[name][-LAST_FRAMES:])
        summary["flicker_mm"] = metrics.flicker_mm(np.array(self._estimates), self._sequence.garment_vertices[self.numbers])
        for name in ("cpu_ms", "wall_ms"):
            summary[f"{name}_p50"], summary[f"{name}_p99"] = np.percentile(self.frames[name], [50, 99])
        summary["states"] = dict(Counter(self.frames["state"]))
        for name, group in self._groups.items():
            summary[name] = group.summary()
        kept = ("rmse_mm", "normal_rmse_mm", "reliability", "paper_score", "coverage", "penetration_mm", "coverage90")
        summary["per_frame"] = {"number": self.numbers} | {name: per_frame[name] for name in kept if name in per_frame}
        summary["per_frame"]["state"] = "".join(state[0] for state in self.frames["state"])
        return {name: _short(value) for name, value in summary.items()}


class Calibration:
    """Claimed covariances of one group of vertices against what was, over many frames; and enough to pool several runs."""

    def __init__(self) -> None:
        self._n, self._nees, self._nll = 0, 0.0, 0.0
        self._inside, self._second = np.zeros(len(NOMINAL)), np.zeros((3, 3))
        self._within90 = 0.0

    def add(self, vertices: np.ndarray, truth: np.ndarray, mahalanobis: np.ndarray, nll: np.ndarray) -> None:
        """The group's vertices (n, 3) of a frame, metres, with (n,) squared Mahalanobis distances and log-likelihoods."""
        n = len(vertices)
        self._n += n
        self._nees += float(mahalanobis.sum()) / 3
        self._nll += float(nll.sum())
        self._within90 += float((mahalanobis < metrics.CHI2_3_90).sum())
        probability = metrics.nominal_probability(mahalanobis)
        self._inside += (probability[:, None] <= np.array(NOMINAL)).sum(axis=0)
        self._second += n * metrics.second_moment(vertices, truth)

    def summary(self) -> dict | None:
        """None without vertices; otherwise ``n``; ``coverage90``; ``nees3``; ``nll`` in nats; ``nll_constant``: that of the
        best constant covariance; ``second_moment``: six entries xx, xy, xz, yy, yz, zz in mm^2; ``inside``: observed share in the
        ellipsoids of the probabilities NOMINAL."""
        if self._n == 0:
            return None
        second = self._second / self._n
        return {
            "n": self._n,
            "coverage90": self._within90 / self._n,
            "nees3": self._nees / self._n,
            "nll": self._nll / self._n,
            "nll_constant": metrics.best_constant_nll(second),
            "second_moment": (1e6 * second[np.triu_indices(3)]).tolist(),
            "inside": (self._inside / self._n).tolist(),
        }


def _mean(values: list) -> float | None:
    """The mean of what is a number: a rank correlation may be undefined in a frame."""
    values = np.array(values, np.float64)
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else None


def _short(value):
    """Numbers with six significant digits, and None for what is none, for JSON."""
    if isinstance(value, dict):
        return {name: _short(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_short(inner) for inner in value]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value

"""Runs of the collection in views and conditions: errors, covariances and evidence of sampled vertices, and reliability."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

import ddakf
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.trials.recordings import find_recording, recording_names
from ddakf.kernels.normals import vertex_normals
from ddakf.stages import error_size
from ddakf.stages.error_size import USUAL, SizeEvidence

VIEWS = ("full", "ring4", "front", "full+body", "front+body")
CONDITIONS = {"": {}, "10 fps": {"every": 3}, "1,000 points": {"points": 1000}, "10 mm noise": {"noise": 0.01}}
DISTURBED_VIEWS = ("full", "full+body", "front+body")
CAPTURED = "captured"  # split and garment of the captures of DDAKF_DATA
CAPTURES = ("pergamo_005", "samba_dress", "samba_whole")
PRESETS = {"default": ddakf.Config, "fast": ddakf.Config.fast}
GROUPS = ("seen", "hidden, body", "hidden")
VERTICES, STRIDE = 60, 4  # saved of a frame, and every how many of its 30 per second
SCALES = ddakf.Config().normal_error  # as those of the other law


class Run(NamedTuple):
    """A recording of the collection as one sensor sees it."""

    listed: collection.Listed
    view: str  # of VIEWS
    condition: str  # of CONDITIONS


class Rows(NamedTuple):
    """Vertices of frames of runs; N rows."""

    run: np.ndarray  # (N,) of the list of runs
    frame: np.ndarray  # (N,) number in the run
    group: np.ndarray  # (N,) of GROUPS
    along2: np.ndarray  # (N,) m^2, squared error along the normal
    across2: np.ndarray  # (N,) m^2, squared error across it, of a covariance whose mean variance there is 1
    reported: np.ndarray  # (N, 3) squared Mahalanobis distance as reported: whole, along the normal, across it
    sigma: np.ndarray  # (N,) m, as reported
    error: np.ndarray  # (N,) m
    evidence: np.ndarray  # (N, 2 + fields) log claimed size along and across, then log(1 + evidence / scale)


class Frames(NamedTuple):
    """Frames of runs; N rows."""

    run: np.ndarray  # (N,) of the list of runs
    frame: np.ndarray  # (N,) number in the run
    rmse: np.ndarray  # (N,) m
    reliability: np.ndarray  # (N,)
    sigma: np.ndarray  # (N,) m, root mean trace of the covariances


def planned(names: Sequence[str] | None) -> list[Run]:
    """The runs: every recording, or those of these names, in all views, and in some of them with a disturbed sensor."""
    known = set(recording_names())
    listed = [each for each in collection.listed() if each.split != collection.FRESH]
    listed += [captured(name) for name in CAPTURES if name in known]
    return [
        Run(each, view, name)
        for each in listed
        if not names or each.name in names
        for name in CONDITIONS
        for view in (DISTURBED_VIEWS if name else VIEWS)
        if "body" not in view or each.split != CAPTURED or find_recording(each.name).has_body
    ]


def captured(name: str) -> collection.Listed:
    """A recording of a real garment, on which constants were chosen."""
    return collection.Listed(name, CAPTURED, "", "", "", CAPTURED, 0, "")


def play(runs: list[Run], frames: int, procs: int, preset: str = "default") -> tuple[Rows, Frames]:
    """Plays the runs, each of this many frames, with a configuration of PRESETS. A recording that is shorter is played backwards
    from its end."""
    jobs = [(number, run, frames, preset) for number, run in enumerate(runs)]
    rows, of_frames = [], []
    with multiprocessing.get_context("spawn").Pool(procs) as pool:
        for done, (part, frame_part) in enumerate(pool.imap(_played, jobs, chunksize=1), start=1):
            rows.append(part)
            of_frames.append(frame_part)
            print(f"{done} of {len(jobs)} runs", end="\r" if done < len(jobs) else "\n", file=sys.stderr, flush=True)
    return Rows(*map(np.concatenate, zip(*rows, strict=True))), Frames(*map(np.concatenate, zip(*of_frames, strict=True)))


def save(path: Path, runs: list[Run], rows: Rows, frames: Frames, settings: str) -> None:
    """Writes what the runs gave with some settings."""
    columns = {f"row_{name}": column for name, column in rows._asdict().items()}
    columns |= {f"frame_{name}": column for name, column in frames._asdict().items()}
    np.savez_compressed(path, runs=_names(runs), settings=settings, fields=SizeEvidence._fields, **columns)


def load(path: Path, runs: list[Run], settings: str) -> tuple[Rows, Frames]:
    """What these runs gave; of the evidence, what the laws have by now.

    Raises:
        SystemExit: the file is of other runs or settings, or lacks evidence.
    """
    with np.load(path) as saved:
        fields = saved["fields"].tolist()
        same = saved["runs"].tolist() == _names(runs) and str(saved.get("settings")) == settings
        if not same or not set(SizeEvidence._fields) <= set(fields):
            raise SystemExit(f"{path} holds other runs: name another file, or delete it")
        rows = Rows(*(saved[f"row_{name}"] for name in Rows._fields))
        columns = [0, 1, *(2 + fields.index(name) for name in SizeEvidence._fields)]
        frames = Frames(*(saved[f"frame_{name}"] for name in Frames._fields))
        return rows._replace(evidence=rows.evidence[:, columns]), frames


def _names(runs: list[Run]) -> list[str]:
    return [f"{run.listed.name} {run.view} {run.condition}" for run in runs]


@contextmanager
def _watched(seen: list) -> Iterator[None]:
    """Records evidence and claimed covariances."""
    resized, evidence = error_size.resized, error_size.evidence

    def keep_evidence(*arguments):
        seen.append(evidence(*arguments))
        return seen[-1]

    def keep_covariance(covariance, *arguments):
        seen.append(covariance)
        return resized(covariance, *arguments)

    error_size.resized, error_size.evidence = keep_covariance, keep_evidence
    try:
        yield
    finally:
        error_size.resized, error_size.evidence = resized, evidence


def _played(job: tuple[int, Run, int, str]) -> tuple[Rows, Frames]:
    number, run, frames, preset = job
    sequence, (view, _, body) = find_recording(run.listed.name), run.view.partition("+")
    given = sequence.body_vertices if body else None
    tracker = ddakf.Tracker(
        ddakf.Mesh(sequence.template, sequence.garment_faces),
        body=None if given is None else ddakf.Mesh(given[0], sequence.body_faces),
        config=PRESETS[preset](),
    )
    tracker.reset(vertices=sequence.garment_vertices[0])
    spread = tracker._working.spread
    sensor, kept, of_frames, seen = Sensor(view=view, **CONDITIONS[run.condition]), [], [], []
    chosen = np.random.default_rng(number).permutation(len(sequence.template))[:VERTICES]
    with _watched(seen):
        for k in range(sensor.every, frames, sensor.every):
            shown = _there_and_back(k, len(sequence))
            cloud = sensor.capture(sequence, shown, np.random.default_rng([1, k]))
            pose = None if given is None else given[shown]
            step = dict(timestamp=k / sequence.fps, sensor_origin=cloud.sensor_origin, body_vertices=pose)
            seen.clear()
            result, truth = tracker.step(cloud.points, **step), sequence.garment_vertices[shown]
            off = result.vertices - truth
            claim = np.sqrt(3.0 * np.square(result.sigma).mean())
            rmse = np.sqrt(np.square(off).sum(axis=1).mean())
            of_frames.append((k, rmse, result.reliability, claim))
            if k % STRIDE < sensor.every and len(seen) == 2:
                of_vertices = error_size.at_vertices(seen[0], tracker._setup.model.patch)
                found = SizeEvidence(*(spread(value) for value in of_vertices))
                columns = _rows(result, (found, spread(seen[1])), truth, sequence.garment_faces, chosen)
                kept.append((np.full(len(chosen), k), *columns))
    frame, observed, *parts = (np.concatenate(part) for part in zip(*kept, strict=True))
    group = np.where(observed, 0, 1 if body else 2)
    table = np.array(of_frames)
    scores = Frames(np.full(len(table), number), *table.T)
    return Rows(np.full(len(group), number), frame, group, *parts), scores


def _there_and_back(k: int, count: int) -> int:
    """The frame of a recording of ``count`` that is shown as number k: forward to its end, back to its start, and so on."""
    k %= 2 * (count - 1)
    return min(k, 2 * (count - 1) - k)


def _rows(result, seen: tuple, truth: np.ndarray, faces: np.ndarray, chosen: np.ndarray) -> tuple:
    """The chosen vertices of a frame: whether they were observed, then the columns of Rows from ``along2`` on."""
    found, claimed = seen
    normal = np.empty(result.vertices.shape)
    vertex_normals(np.ascontiguousarray(result.vertices, np.float64), np.ascontiguousarray(faces, np.int32), normal)
    normal, error = normal[chosen], (result.vertices - truth)[chosen]
    basis = np.linalg.svd(normal[:, None, :])[2]  # the normal, then two tangents
    claimed = basis @ claimed[chosen] @ basis.transpose(0, 2, 1)
    reported = basis @ result.covariance[chosen].astype(float) @ basis.transpose(0, 2, 1)
    rotated = np.einsum("vab,vb->va", basis, error)
    variance = 0.5 * (claimed[:, 1, 1] + claimed[:, 2, 2])
    columns = [np.log1p(value[chosen] / getattr(SCALES, f"{name}_scale")) for name, value in found._asdict().items()]
    distances = [_mahalanobis2(rotated, reported), rotated[:, 0] ** 2 / reported[:, 0, 0]]
    return (
        result.observed[chosen],
        rotated[:, 0] ** 2,
        _mahalanobis2(rotated[:, 1:], claimed[:, 1:, 1:] / variance[:, None, None]),
        np.column_stack([*distances, _mahalanobis2(rotated[:, 1:], reported[:, 1:, 1:])]),
        np.sqrt(np.einsum("vaa->v", reported) / 3.0),
        np.linalg.norm(error, axis=1),
        np.column_stack([0.5 * np.log(claimed[:, 0, 0] / USUAL**2), 0.5 * np.log(variance / USUAL**2), *columns]),
    )


def _mahalanobis2(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(N,) squared Mahalanobis distances of errors (N, k) with covariances (N, k, k)."""
    return np.einsum("va,vab,vb->v", error, np.linalg.inv(covariance), error)

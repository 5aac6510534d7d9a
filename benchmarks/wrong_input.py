"""Wrong input: what the tracker says about each mistake, and that it says nothing about good input.

``--part origin``: one camera whose origin is withheld, against the same with the origin. ``--part mistakes``: units, clocks,
axes, places. ``--part good``: every view, with its origins, at several frame rates, with gaps and empty frames; no warning is
due. It also says how long the checks take.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

import ddakf
from ddakf import data
from ddakf.config import Sidedness, Start
from ddakf.errors import InvalidArgument
from ddakf.evaluation.sensors import Sensor
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.tracking.sources import SequenceSource
from ddakf.evaluation.trials.recordings import find_recording, recording_names
from ddakf.files.sequence import Sequence

WRONG = 50.0  # mm
CHECKS = ("input", "warnings")  # stages of a step


class Run(NamedTuple):
    """Numbers of one run, each frame's."""

    rmse: np.ndarray  # mm
    reliability: np.ndarray
    sigma: np.ndarray  # mm, mean over the vertices
    warnings: Counter  # by code
    sentences: dict  # by code, the last
    errors: list  # of refused frames
    states: Counter
    cost: np.ndarray  # ms


def track(frames: Iterable[CapturedFrame], source: SequenceSource, config: ddakf.Config | None = None) -> Run:
    """Tracks frames, of which refused ones are skipped."""
    tracker = ddakf.Tracker(source.garment, body=source.body, config=config)
    if source.start is not None:
        tracker.reset(source.start)
    rows, codes, sentences, errors, states = [], Counter(), {}, [], Counter()
    for frame in frames:
        how = {"sensor_origin": frame.sensor_origin, "body_vertices": frame.body_vertices}
        try:
            result = tracker.step(frame.points, timestamp=frame.timestamp, **how)
        except InvalidArgument as error:
            errors.append(str(error))
            continue
        codes.update(warning.code for warning in result.warnings)
        sentences |= {warning.code: f"{warning.field}: {warning.message}" for warning in result.warnings}
        states[result.state] += 1
        rmse = 1e3 * np.sqrt(np.square(result.vertices - frame.truth).sum(axis=1).mean())
        cost = 1e3 * sum(result.timings.get(name, 0.0) for name in CHECKS)
        rows.append((rmse, result.reliability, 1e3 * result.sigma.mean(), cost))
    rmse, reliability, sigma, cost = np.array(rows).reshape(-1, 4).T
    return Run(rmse, reliability, sigma, codes, sentences, errors, states, cost)


def source_of(name: str, view: str, frames: int, start: str = "truth", **sensor) -> SequenceSource:
    """The source of a recording; ``view`` ends in ``+body`` where the tracker is told the body."""
    view, _, body = view.partition("+")
    sequence = find_recording(name)
    return SequenceSource(sequence, Sensor(view, **sensor), range(min(frames, len(sequence))), start, give_body=bool(body))


# An origin that is withheld -----------------------------------------------------------------------------------------


def origin_row(case: tuple[str, int]) -> str:
    """A row of the table: the origin given; withheld and estimated; not estimated but missed; not even missed."""
    source, cells = source_of(case[0], "front", case[1]), []
    captured = list(source)
    withheld = [dataclasses.replace(frame, sensor_origin=None) for frame in captured]
    before = dataclasses.replace(ddakf.Config(), sidedness=Sidedness(one_sided=0.0))
    blind = dataclasses.replace(ddakf.Config(), sidedness=Sidedness(estimate=False))
    for clouds, config in ((captured, None), (withheld, None), (withheld, blind), (withheld, before)):
        run = track(clouds, source, config)
        wrong = ((run.rmse > WRONG) & (run.reliability > 0.5)).mean()
        cells.append(f"{run.rmse.mean():.1f}, {run.reliability.mean():.2f}, {run.sigma.mean():.0f}, {wrong:.0%}")
    return f"| {case[0]} | {' | '.join(cells)} |"


def origin(arguments: argparse.Namespace) -> int:
    """Prints the table of runs without the origin."""
    print(f"RMSE mm, mean reliability, mean sigma mm, share of frames over {WRONG:.0f} mm with a reliability over 0.5\n")
    print("| recording | origin given | withheld | no estimate | no look |\n|---|---|---|---|---|")
    for row in arguments.map(origin_row, [(name, arguments.frames) for name in arguments.recordings]):
        print(row, flush=True)
    return 0


# Mistakes -----------------------------------------------------------------------------------------------------------


def mistakes() -> dict:
    """By name, what a mistake makes of a frame and of the source."""

    def points(change):
        return lambda frame: dataclasses.replace(frame, points=np.ascontiguousarray(change(frame.points), np.float32))

    def origin(change):
        return lambda frame: dataclasses.replace(frame, sensor_origin=change(frame))

    def time(factor):
        return lambda frame: dataclasses.replace(frame, timestamp=factor * frame.timestamp)

    def after(count, change):
        return lambda frame: change(frame) if frame.number > count else frame

    def overturned(frame):
        middle, over = frame.points.mean(axis=0), np.array([1, -1, -1])
        return points(lambda p: (p - middle) * over + middle)(origin(lambda f: (f.sensor_origin - middle) * over + middle)(frame))

    def apart(frame):
        return dataclasses.replace(frame, body_vertices=frame.body_vertices + [2.0, 0.0, 0.0])

    poses = []

    def late(frame):
        poses.append(frame.body_vertices)
        return dataclasses.replace(frame, body_vertices=poses[-4:][0])

    def misplaced(frame):
        _, sensor = np.unique(frame.sensor_origin, axis=0, return_inverse=True)
        shift = CAMERAS_OFF[sensor.ravel()]
        return points(lambda p: p + shift)(origin(lambda f: f.sensor_origin + shift)(frame))

    return {
        "none": lambda frame: frame,
        "no sensor origin": origin(lambda frame: None),
        "millimetres": points(lambda p: 1e3 * p),
        "inches": points(lambda p: 39.37 * p),
        "millimetres, after ten frames": after(10, points(lambda p: 1e3 * p)),
        "a wall instead of the garment": points(lambda p: np.random.default_rng(0).uniform([-1, 0, -3], [1, 2, -2.99], p.shape)),
        "milliseconds": time(1e3),
        "clock stands nearly still": time(1e-3),
        "origin amid the cloud": origin(lambda frame: frame.points.mean(axis=0)),
        "origin on the other side": origin(lambda frame: 2 * frame.points.mean(axis=0) - frame.sensor_origin),
        "depth axis reversed": points(lambda p: p * [1, 1, -1] + [0, 0, 2 * p[:, 2].mean()]),
        "upside down": overturned,
        "body elsewhere": apart,
        "body three frames late": late,
        "z taken for the vertical, with a body": lambda frame: frame,
        "body on its head": lambda frame: frame,
        "a whole person": lambda frame: frame,
        "template split along a seam": lambda frame: frame,
        "template 8 % too small, all around": lambda frame: frame,
        "four cameras, 10 mm off": misplaced,
    }


CAMERAS_OFF = 0.01 * np.array([[1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # m, from where they are
VERTICAL = {"z taken for the vertical, with a body": "z", "body on its head": "-y"}  # of the mistakes in the configuration


VIEWS = {"body": "front+body", "all around": "full", "four cameras": "ring4"}  # by a part of a mistake's name; else one camera


def split(sequence: Sequence) -> Sequence:
    """The recording with a garment whose left and right half have vertices of their own."""
    faces, n = sequence.garment_faces, len(sequence.template)
    right = sequence.template[faces].mean(axis=1)[:, 0] > 0
    seam, copy = np.intersect1d(faces[right], faces[~right]), np.arange(n)
    copy[seam] = n + np.arange(len(seam))
    both = np.append(np.arange(n), seam)
    return dataclasses.replace(
        sequence,
        garment_rest=sequence.template[both],
        garment_vertices=sequence.garment_vertices[:, both],
        garment_faces=np.where(right[:, None], copy[faces], faces),
    )


def mistake(case: tuple[str, int]) -> list[str]:
    """What the tracker says about a mistake, in lines."""
    name, frames = case
    view = next((view for part, view in VIEWS.items() if part in name), "front")
    source = source_of("sample", view, frames, "truth", segmented="whole person" not in name)
    if "split" in name:
        source = dataclasses.replace(source, sequence=split(source.sequence))
    if "too small" in name:
        small = dataclasses.replace(source.sequence, garment_rest=0.92 * source.sequence.template)
        source = dataclasses.replace(source, sequence=small)
    config = dataclasses.replace(ddakf.Config(), start=Start(up=VERTICAL.get(name, "y")))
    run = track(map(mistakes()[name], source), source, config)
    lines = [f"{name}: {dict(run.states)}"]
    if len(run.rmse):
        lines[0] += f", RMSE {run.rmse.mean():.0f} mm, reliability {run.reliability.mean():.2f}, sigma {run.sigma.mean():.0f} mm"
    lines += [f"    warning {code} in {count} frames, {run.sentences[code]}" for code, count in run.warnings.items()]
    lines += [f"    {len(run.errors)} refused: {run.errors[0]}"] if run.errors else []
    return lines


def wrong(arguments: argparse.Namespace) -> int:
    """Prints what the tracker says about each mistake."""
    for lines in arguments.map(mistake, [(name, arguments.frames) for name in mistakes()]):
        print(*lines, sep="\n", flush=True)
    return 0


# Good input ---------------------------------------------------------------------------------------------------------


def disturbed(frames: Iterable[CapturedFrame]) -> Iterator[CapturedFrame]:
    """Frames with two gaps of half a second and of three seconds, and two runs of empty ones."""
    for k, frame in enumerate(frames):
        if k % 60 in range(20, 25) or 35 <= k % 120 < 50:
            frame = dataclasses.replace(frame, points=frame.points[:0], sensor_origin=None)
        if 70 <= k % 160 < 85:
            continue
        yield dataclasses.replace(frame, timestamp=frame.timestamp + 3.0 * (k // 40))


def good_case(case: tuple[str, str, str, int]) -> tuple[str, Counter, dict, float, bool]:
    """The warnings about good input of one kind, and whether the garment was ever found: where not, a warning is right."""
    name, view, kind, frames = case
    how = {"10 fps": {"every": 3}, "noisy": {"noise": 0.01, "drop": 0.4}, "outliers": {"outliers": 0.1}}.get(kind, {})
    start = "search" if kind == "search" else "truth"
    if view.startswith("person"):
        view, how = view.replace("person", "front"), how | {"segmented": False}
    source = source_of(name, view, frames, start, **how)
    run = track(disturbed(source) if kind == "disturbed" else source, source)
    return f"{name}, {case[1]}, {kind}", run.warnings, run.sentences, float(np.mean(run.cost)), "tracking" in run.states


def good(arguments: argparse.Namespace) -> int:
    """Counts the warnings about good input; the exit status is 1 if there are any of a garment that was found."""
    kinds = ("30 fps", "10 fps", "disturbed", "noisy", "outliers", "search")
    views = ("full", "front", "ring4", "front+body", "person+body")
    cases = [
        (name, view, kind, arguments.frames)
        for name in arguments.recordings
        for view in views
        for kind in kinds
        if ("body" not in view or find_recording(name).has_body) and (kind == "30 fps" or "+" not in view)
    ]
    alarms, not_found, costs = 0, 0, []
    for title, codes, sentences, cost, found in arguments.map(good_case, cases):
        alarms += bool(codes) and found
        not_found += not found
        costs.append(cost)
        title += "" if found else " (never found)"
        for code, count in codes.items():
            print(f"{title}: {code} in {count} frames, {sentences[code]}", flush=True)
    print(f"{len(cases)} runs, {alarms} with a false alarm, {not_found} in which a search never found the garment")
    print(f"checks per frame: {np.mean(costs):.3f} ms, {max(costs):.3f} at most")
    return int(alarms > 0)


PARTS = {"origin": origin, "mistakes": wrong, "good": good}


def main(argv: list[str] | None = None) -> int:
    """Runs a part; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=PARTS, default="mistakes")
    shipped = sorted(path.stem for path in data.TRAINING.glob("*.npz"))
    names = [*recording_names(), *(name for name in shipped if name not in recording_names())]
    parser.add_argument("--recordings", nargs="+", default=names, metavar="NAME")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--procs", type=int, default=2)
    arguments = parser.parse_args(argv)
    with ProcessPoolExecutor(arguments.procs, get_context("spawn")) as pool:
        arguments.map = pool.map
        return PARTS[arguments.part](arguments)


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

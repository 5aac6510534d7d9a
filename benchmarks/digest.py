"""Digests of every result array on six recordings: a refactoring changes none of them.

``python benchmarks/digest.py --out before.json`` at the old commit, then ``--against before.json`` at the new one, on the same
machine: floating point differs between processors, so the digests of another machine say nothing.

Each run is interrupted in the middle by a snapshot; the restored tracker goes on. Recordings of DDAKF_DATA that are absent are
left out and named.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import ddakf
from ddakf.evaluation.sensors import Sensor
from ddakf.evaluation.tracking.sources import SequenceSource
from ddakf.evaluation.trials.recordings import find_recording, recording_names
from ddakf.files.sequence import load_sequence

RECORDINGS = ("sample", "tank_squat", "dress_dance", "pergamo_005", "samba_dress", "sim_tank_move")
VIEWS = ("full", "front", "front+body", "person+body", "search")
SHORT = {"person+body": 30, "search": 20}  # frames of the conditions that repeat a view
FRAMES = 60
TRAINING = Path(ddakf.__file__).parent / "data/training"


def main(argv: list[str] | None = None) -> int:
    """Writes or compares the digests; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="write the digests here")
    parser.add_argument("--against", type=Path, help="compare with the digests of this file")
    parser.add_argument("--recordings", nargs="+", default=RECORDINGS, metavar="NAME")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--procs", type=int, default=2)
    arguments = parser.parse_args(argv)
    cases, digests = list(_cases(arguments)), {}
    with ProcessPoolExecutor(arguments.procs, get_context("spawn")) as pool:
        for case, value in zip(cases, pool.map(digest, cases), strict=True):
            digests[" ".join(map(str, case))] = value
            print(f"{' '.join(map(str, case)):55} {value}", flush=True)
    if arguments.out:
        arguments.out.write_text(json.dumps(digests, indent=1) + "\n")
    return 0 if arguments.against is None else _compare(json.loads(arguments.against.read_text()), digests)


def _cases(arguments):
    for name in arguments.recordings:
        if name not in recording_names() and not (TRAINING / f"{name}.npz").exists():
            print(f"{name}: absent, set DDAKF_DATA", file=sys.stderr)
            continue
        body = _sequence(name).has_body
        for view in VIEWS:
            for preset in ("default", "paper"):
                if (body or "body" not in view) and (preset == "default" or view not in SHORT):
                    yield name, view, preset, min(arguments.frames, SHORT.get(view, arguments.frames))


def digest(case: tuple[str, str, str, int]) -> str:
    """Of the results of one run: all arrays and numbers but the times, in timings and usage."""
    name, condition, preset, frames = case
    view, _, body = condition.partition("+")
    sensor = Sensor("full" if view == "search" else "front" if view == "person" else view, 10_000, segmented=view != "person")
    source = SequenceSource(
        _sequence(name), sensor, range(frames), "search" if view == "search" else "truth", give_body=bool(body)
    )
    config = ddakf.Config() if preset == "default" else ddakf.Config.paper()
    tracker = ddakf.Tracker(source.garment, body=source.body, config=config)
    if source.start is not None:
        tracker.reset(vertices=source.start)
    total = hashlib.sha256()
    for number, frame in enumerate(source):
        result = tracker.step(
            frame.points,
            timestamp=frame.timestamp,
            sensor_origin=frame.sensor_origin,
            body_vertices=frame.body_vertices if preset == "default" else None,
        )
        for field in dataclasses.fields(result):
            if field.name not in ("timings", "usage"):
                value = getattr(result, field.name)
                total.update(value.encode() if isinstance(value, str) else np.ascontiguousarray(value).tobytes())
        if number == frames // 2:
            total.update(tracker.predicted(result, 0.02).vertices.tobytes())
            tracker = ddakf.Tracker.restore(tracker.snapshot())
    return total.hexdigest()[:24]


def _sequence(name: str):
    path = TRAINING / f"{name}.npz"
    return load_sequence(path) if path.exists() else find_recording(name)


def _compare(before: dict[str, str], now: dict[str, str]) -> int:
    changed = [case for case, value in now.items() if before.get(case) != value]
    print(f"{len(now) - len(changed)} of {len(now)} digests are equal" + "".join(f"\nchanged: {case}" for case in changed))
    return 1 if changed else 0


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

"""Growth of the error by the work that a budget leaves out: ``python benchmarks/omission.py [--procs 2] [--frames 60]``.

Tracks the training recordings of the collection with parts of the work left out in every frame, with budgets of shares of the
processor time that a whole frame takes there, and with ``Config.fast()``. Prints for each the error and the processor time over
those of whole frames of the default, the shares of seen and of hidden vertices in their 90 % ellipsoids, and, of budgets, the
frames that took more than 1.2 times as long. ``--fit``
prints the growths of ``Omission``: least squares, none negative, of the logarithm of each run's error over that of whole frames.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from committed import parsed
from scipy.optimize import nnls

import ddakf
from ddakf.evaluation import machine
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.files.sequence import Sequence
from ddakf.planning import omission, plan
from ddakf.planning.work import Effort

RESULT = Path(__file__).parent / "results/omission.json"
VIEWS = ("full", "front+body")
POINTS, WHOLE, FAST = 10_000, "nothing", "`Config.fast()`"
INSIDE = 6.251  # squared Mahalanobis distance of the 90 % ellipsoid
SLACK = 1.2  # over its budget: a frame that took longer is late
SHARES = (1.3, 1.0, 0.85, 0.75)  # of the median time of a whole frame
NONE, ONE, TWO = (Effort(passes=count) for count in range(3))
# functions of ddakf.planning.plan, and the work that each allows instead
FORCED = {
    "half the points": {"limit_points": Effort(points=0.5)},
    "a quarter of the points": {"limit_points": Effort(points=0.25)},
    "no cluster alignment": {"limit_alignment": NONE},
    "all but two passes": {"limit_passes": TWO},
    "all but one pass": {"limit_passes": ONE},
    "the same, cluster alignment": {"limit_alignment": NONE, "limit_passes": ONE},
    "the same, half the points": {"limit_points": Effort(points=0.5), "limit_alignment": NONE, "limit_passes": ONE},
}
GROWTHS = ("points", "clusters", "passes")


class Run(NamedTuple):
    """A recording in a view, with some work left out."""

    error: float  # m, root of the mean squared error
    seconds: np.ndarray  # processor time of each frame
    omitted: np.ndarray  # (3,) mean of the work left out, in the order of GROWTHS
    inside: tuple[float, float]  # share of the seen and of the hidden vertices
    late: float  # share of the frames


@contextmanager
def forced(efforts: dict[str, Effort], seen: list) -> Iterator[None]:
    """Every frame's work is cut so; what is left out of each frame is appended to the list."""
    efforts = {"limit_points": Effort()} | efforts if efforts else {}
    before = {name: getattr(plan, name) for name in efforts}
    widening = omission.widening

    def watched(problem, estimate):
        seen.append(np.array(omission.omitted(problem, estimate)))
        return widening(problem, estimate)

    def fixed(effort: Effort) -> Callable:
        return lambda clock, problem: problem._replace(effort=effort._replace(planned=True))

    for name, effort in efforts.items():
        setattr(plan, name, fixed(effort))
    omission.widening = watched
    try:
        yield
    finally:
        omission.widening = widening
        for name, function in before.items():
            setattr(plan, name, function)


class Recording(NamedTuple):
    """A recording in a view."""

    sequence: Sequence
    body: ddakf.Mesh | None
    frames: list[dict]  # arguments of ``Tracker.step``, and the ``truth``


def run(
    recording: Recording,
    budget: float | None = None,
    efforts: dict[str, Effort] | None = None,
    config: ddakf.Config | None = None,
) -> Run:
    """A run of a recording."""
    sequence, body, frames = recording
    tracker = ddakf.Tracker(ddakf.Mesh(sequence.garment_rest, sequence.garment_faces), body=body, config=config)
    tracker.reset(vertices=sequence.garment_vertices[0])
    squares, seconds, inside, seen, late = [], [], [], [], 0
    with forced(efforts or {}, seen):
        for frame in frames:
            result = tracker.step(**{key: value for key, value in frame.items() if key != "truth"}, budget=budget)
            error = result.vertices - frame["truth"]
            squares.append(np.square(error).sum(axis=1).mean())
            seconds.append(result.usage.seconds)
            late += budget is not None and result.usage.seconds > SLACK * budget
            distance = np.einsum("va,vab,vb->v", error, np.linalg.inv(result.covariance), error)
            groups = (result.observed, ~result.observed)
            inside.append([(distance[group] < INSIDE).mean() if group.any() else np.nan for group in groups])
    shares = tuple(float(share) for share in np.nanmean(inside, axis=0))
    return Run(math.sqrt(np.mean(squares)), np.array(seconds), np.mean(seen, axis=0), shares, late / len(frames))


def runs(job: tuple[str, str, int]) -> dict[str, Run]:
    """All runs of a recording in a view, by what is left out."""
    name, view, count = job
    sequence, (view, _, given) = collection.load(name), view.partition("+")
    sensor, frames = Sensor(view=view, points=POINTS), []
    body = ddakf.Mesh(sequence.body_vertices[0], sequence.body_faces) if given else None
    for k in range(1, min(count + 1, len(sequence))):
        cloud = sensor.capture(sequence, k, np.random.default_rng([1, k]))
        pose = sequence.body_vertices[k] if given else None
        where = dict(timestamp=k / sequence.fps, sensor_origin=cloud.sensor_origin, body_vertices=pose)
        frames.append(where | {"points": cloud.points, "truth": sequence.garment_vertices[k]})
    recording = Recording(sequence, body, frames)
    found = {WHOLE: run(recording)}
    whole = float(np.median(found[WHOLE].seconds))
    for what, efforts in FORCED.items():
        found[what] = run(recording, efforts=efforts)
    for share in SHARES:
        found[f"budget {share:g}"] = run(recording, budget=share * whole)
    found[FAST] = run(recording, config=ddakf.Config.fast())
    print(f"{name} {job[1]}: {1e3 * found[WHOLE].error:.1f} mm in {1e3 * whole:.1f} ms", file=sys.stderr, flush=True)
    return found


def table(found: list[dict[str, Run]]) -> list[dict]:
    """Prints and returns a row for each kind of omission: geometric means over the runs."""
    print("| left out in every frame | error | worst run | time | in the ellipsoids, seen, hidden | frames beyond 1.2 budgets |")
    print("|---|---|---|---|---|---|")
    rows = []
    for what in found[0]:
        growth = np.array([each[what].error / each[WHOLE].error for each in found])
        time = np.array([np.median(each[what].seconds) / np.median(each[WHOLE].seconds) for each in found])
        inside = np.nanmean([each[what].inside for each in found], axis=0)
        late = float(np.mean([each[what].late for each in found]))
        row = {"left_out": what, "error": _mean(growth), "worst": round(float(growth.max()), 3), "time": _mean(time)}
        rows.append(row | {"inside": [round(float(share), 3) for share in inside], "late": round(late, 4)})
        shown, shares = f"{late:.1%}" if what.startswith("budget") else "", ", ".join(f"{share:.0%}" for share in inside)
        print(f"| {what} | {row['error']:.2f} | {row['worst']:.2f} | {row['time']:.2f} | {shares} | {shown} |")
    return rows


def fitted(found: list[dict[str, Run]]) -> dict[str, float]:
    """The growths."""
    kinds = [what for what in found[0] if what not in (WHOLE, FAST)]
    A = np.array([each[what].omitted for each in found for what in kinds])
    b = np.array([math.log(each[what].error / each[WHOLE].error) for each in found for what in kinds])
    return {f"{name}_growth": round(float(value), 3) for name, value in zip(GROWTHS, nnls(A, b)[0], strict=True)}


def _mean(ratios: np.ndarray) -> float:
    return round(float(np.exp(np.mean(np.log(ratios)))), 3)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fit", action="store_true", help="print the growths")
    parser.add_argument("--frames", type=int, default=60, help="per recording (default 60)")
    parser.add_argument("--procs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--recordings", nargs="+", metavar="NAME", help="default: all for training")
    parser.add_argument("--json", type=Path, nargs="?", const=RESULT, metavar="FILE", help="of the table and the growths")
    arguments = parsed(parser, argv, target="json")
    listed = [each.name for each in collection.listed(collection.TRAINING)]
    names = [name for name in listed if not arguments.recordings or name in arguments.recordings]
    jobs = [(name, view, arguments.frames) for name in names for view in VIEWS]
    with multiprocessing.get_context("spawn").Pool(arguments.procs) as pool:
        found = pool.map(runs, jobs, chunksize=1)
    report = {"machine": machine.describe(), "commit": machine.commit(), "rows": table(found)}
    if arguments.fit:
        report["growths"] = fitted(found)
        print(report["growths"])
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

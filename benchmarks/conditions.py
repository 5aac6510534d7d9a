"""Short clips of training recordings under a stranger's conditions: ``python benchmarks/conditions.py [--against ROWS.json]``.

Each recording is tracked from one camera and from all around, with and without the body, and from four cameras; undisturbed, at
10 frames per second, with 1,000 points, with 10 mm of noise, in a cloud of the whole person, without colours and with those of
skin and of a plain garment, with a side that is never seen, with a body that is misplaced by 10 mm as estimates of it are,
:func:`misplaced`, with cameras that are misplaced by 10 mm, :func:`misplaced_cameras`, and with a template, and a start, that
are 5 % larger than the garment, or smaller; with ``--seeds`` several times. Printed are RMSE, reliability and the share of seen
vertices in their 90 % ellipsoids, by garment and in the mean; with ``--against`` the change of the error since other rows,
which another version of the tracker has left with ``--out``. Changes are chosen here, so held-out recordings are not among
these; ``--held-out`` tracks them instead, for a final score. ``--json`` writes the errors by garment into
benchmarks/results/conditions.json, from which ``--table`` prints the tables of docs/results/conditions.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import sys
import time
import zlib
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np
from committed import parsed
from inputs import TEXTURES
from scipy.spatial.transform import Rotation

import ddakf
from ddakf.body import contact
from ddakf.evaluation import machine
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors.captured_frame import Cloud
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.trials.recordings import find_recording
from ddakf.files.sequence import Sequence

RESULT = Path(__file__).parent / "results/conditions.json"
FIRST, FRAMES = 30, 48  # frame of the start, when all are in motion, and frames of the clip
INSIDE = 6.251  # squared Mahalanobis distance of the 90 % ellipsoid
TITLES = {
    "full": "all around", "full+body": "all around, body", "ring4": "four cameras", "front+body": "one camera, body",
    "front": "one camera alone",
}  # fmt: skip
VIEWS = tuple(TITLES)
LASTING = 10  # frames between independent values of the lasting part of a body's error
TURN = 3.0  # rad per metre: a body's error of 10 mm comes with one of 1.7 degrees
CONDITIONS = {
    "plain": {},
    "10 fps": {"every": 3},
    "1,000 points": {"points": 1000},
    "10 mm": {"noise": 0.01},
    "whole person": {"segmented": False},
    "coloured person": {"segmented": False},
    "hidden side": {"occlude": (FIRST + 1, 10_000)},
    "body 10 mm off": {},
    "cameras 10 mm off": {},
    "template 5 % large": {},
    "template 5 % small": {},
}
BODY_SD = {"body 10 mm off": 0.01}  # m, of the body's error where there is one
CAMERAS_OFF = {"cameras 10 mm off": 0.01}  # m, error of each camera's place where it has one
SIZES = {"template 5 % large": 1.05, "template 5 % small": 1.0 / 1.05}  # template over garment
CAMERA_TURN = np.radians(0.3)  # about an axis through a camera that is misplaced
RECORDINGS = (
    "trousers_dance_loose_11", "trousers_jump_loose_33", "shorts_turn_close_26", "straight-skirt_random_close_02",
    "straight-skirt_dance_close_24", "skirt_squat_loose_53", "dress_sit_loose_29", "cape_turn_loose_39",
    "long-shirt_run_loose_45", "hoodie_walk_loose_47", "jacket_walk_close_60", "tshirt_dance_loose_63", "tank_run_close_32",
)  # fmt: skip


@lru_cache(maxsize=1)
def _loaded(name: str) -> Sequence:
    return find_recording(name)


@lru_cache(maxsize=2)
def _tracker(name: str, with_body: bool, config: str, size: float) -> ddakf.Tracker:
    """A tracker of a recording, whose template is ``size`` times as large; building it takes as long as some dozen frames."""
    sequence = _loaded(name)
    body = ddakf.Mesh(sequence.body_vertices[FIRST], sequence.body_faces) if with_body else None
    garment = ddakf.Mesh(size * sequence.template, sequence.garment_faces)
    return ddakf.Tracker(garment, body=body, config=ddakf.Config.from_dict(json.loads(config)))


def run(job: tuple[str, str, str, int, str, int]) -> dict:
    """The row of a recording in a view under a condition: so many frames of it, a configuration in JSON, and a seed."""
    name, view, condition, frames, config, seed = job
    sequence, (side, _, with_body) = _loaded(name), view.partition("+")
    sensor, body_sd = Sensor(side, **CONDITIONS[condition]), BODY_SD.get(condition, 0.0)
    size, start = SIZES.get(condition, 1.0), sequence.garment_vertices[FIRST]
    tracker = _tracker(name, bool(with_body), config, size)
    tracker.reset(vertices=start + (size - 1.0) * (start - start.mean(axis=0)))
    # a low rate gives few frames, so that its clip goes to the recording's end
    last = len(sequence) if sensor.every > 1 else min(FIRST + 1 + frames, len(sequence))
    error, reliable, inside, seconds = [], [], [], []
    for k in range(FIRST + sensor.every, last, sensor.every):
        cloud = sensor.capture(sequence, k, np.random.default_rng([seed, k]), TEXTURES.get(condition))
        pose = misplaced(sequence.body_vertices[k], body_sd, k, (zlib.crc32(name.encode()), seed)) if with_body else None
        points, origin = misplaced_cameras(cloud, CAMERAS_OFF.get(condition, 0.0), (zlib.crc32(name.encode()), seed))
        colors = getattr(cloud, "colors", None)
        before = time.thread_time()
        result = tracker.step(points, timestamp=k / sequence.fps, sensor_origin=origin, body_vertices=pose, colors=colors)
        seconds.append(time.thread_time() - before)
        off = result.vertices - sequence.garment_vertices[k]
        error.append(1e3 * np.sqrt(np.square(off).sum(axis=1).mean()))
        reliable.append(result.reliability)
        if result.observed.any():
            off, covariance = off[result.observed], result.covariance[result.observed]
            inside.append((np.einsum("va,va->v", off, np.linalg.solve(covariance, off[:, :, None])[:, :, 0]) < INSIDE).mean())
    row = {"recording": name, "view": view, "condition": condition, "seed": seed, "frames": frames, "rmse_mm": np.mean(error)}
    row |= {"reliability": np.mean(reliable), "coverage": np.mean(inside or [0.0]), "cpu_ms": 1e3 * np.median(seconds)}
    row["wrong"] = np.mean((np.array(error) > 50.0) & (np.array(reliable) >= 0.5))
    if with_body and condition == "plain":
        row |= predictors(sequence, range(FIRST + 1, last))
    return {key: round(float(value), 4) if isinstance(value, float) else value for key, value in row.items()}


def misplaced(body: np.ndarray, sd: float, frame: int, seed: tuple[int, int]) -> np.ndarray:
    """A body (B, 3) in metres, shifted and turned about its middle by a random error.

    The shift has the standard deviation ``sd``, in metres, along each axis, the turn :data:`TURN` times as many radians about
    each. Both last :data:`LASTING` frames. Half as much is added anew in each frame.
    """
    if sd == 0.0:
        return body
    drawn = lambda *index: np.random.default_rng([*seed, *index]).normal(size=(2, 3))  # noqa: E731
    block, share = frame // LASTING, frame % LASTING / LASTING
    lasting = ((1.0 - share) * drawn(0, block) + share * drawn(0, block + 1)) / np.hypot(share, 1.0 - share)
    shift, turn = sd * (lasting + 0.5 * drawn(1, frame))
    middle = body.mean(axis=0)
    return Rotation.from_rotvec(TURN * turn).apply(body - middle) + middle + shift


def misplaced_cameras(cloud: Cloud, off: float, seed: tuple[int, int]) -> tuple[np.ndarray, np.ndarray | None]:
    """Points (N, 3) and origins of a cloud, metres, each camera of which is shifted by ``off`` in a random direction, and turned.

    The turn is :data:`CAMERA_TURN` about a random axis through the camera. Both stay the same for a recording.
    """
    if off == 0.0:
        return cloud.points, cloud.sensor_origin
    points, origin = np.array(cloud.points, np.float64), np.array(cloud.sensor_origin, np.float64)
    for camera, eye in enumerate(np.unique(cloud.sensor_origin, axis=0)):
        shift, axis = np.random.default_rng([*seed, camera]).normal(size=(2, 3))
        shift *= off / np.linalg.norm(shift)
        its = (cloud.sensor_origin == eye).all(axis=1)
        turn = Rotation.from_rotvec(CAMERA_TURN * axis / np.linalg.norm(axis))
        points[its] = turn.apply(points[its] - eye) + eye + shift
        origin[its] += shift
    return points.astype(np.float32), origin


def predictors(sequence: Sequence, frames: Iterable[int]) -> dict[str, float]:
    """RMSE, mm, of a garment that stays where it starts and of one that the body carries from there."""
    config, start = ddakf.Config(), np.asarray(sequence.garment_vertices[FIRST], np.float64)
    body = contact.build(ddakf.Mesh(sequence.body_vertices[FIRST], sequence.body_faces), config.predict.carry_reach)
    track = contact.start(body, start, config.physics)
    bound = contact.bind(body, track.vertices, start, config.anchor.reach)
    errors = []
    for k in frames:
        pose = contact.posed(body, track, np.asarray(sequence.body_vertices[k], np.float64))
        found = start, contact.follow(bound, pose, config.anchor.reach)
        errors.append([1e3 * np.sqrt(np.square(place - sequence.garment_vertices[k]).sum(axis=1).mean()) for place in found])
    return dict(zip(("stay_mm", "carried_mm"), np.mean(errors, axis=0).tolist(), strict=True))


# Tables -------------------------------------------------------------------------------------------------------------


def garment_of(row: dict) -> str:
    return row["recording"].partition("_")[0]


def key_of(row: dict) -> tuple:
    return row["recording"], row["view"], row["condition"], row.get("seed", 1)


def table(rows: list[dict], cell: Callable[[list[dict]], str], conditions: Iterable[str]) -> None:
    """Prints a cell for each garment and view, and for each view in the mean, by condition."""
    conditions = list(conditions)
    print(f"{'':28s}" + "".join(f"{name:>20s}" for name in conditions))
    for view in dict.fromkeys(row["view"] for row in rows):
        mine = [row for row in rows if row["view"] == view]
        for garment in [*dict.fromkeys(map(garment_of, mine)), "all"]:
            chosen = [row for row in mine if garment in (garment_of(row), "all")]
            cells = [[row for row in chosen if row["condition"] == name] for name in conditions]
            print(f"{view + ' ' + garment:28s}" + "".join(f"{cell(each) if each else '':>20s}" for each in cells))


def geometric(rows: list[dict], name: str) -> float:
    """Geometric mean of a field."""
    return float(np.exp(np.mean([np.log(row[name]) for row in rows])))


def scores(rows: list[dict]) -> str:
    """RMSE mm, reliability, share in the ellipsoids."""
    mean = {name: np.mean([row[name] for row in rows]) for name in ("reliability", "coverage")}
    return f"{geometric(rows, 'rmse_mm'):.1f} {mean['reliability']:.2f} {mean['coverage']:.0%}"


def report(rows: list[dict]) -> None:
    """Prints the scores, and the errors over those of the best predictor where the body is given."""
    names = [name for name in CONDITIONS if any(row["condition"] == name for row in rows)]
    print("RMSE mm (geometric mean), reliability, seen vertices in their 90 % ellipsoids")
    table(rows, scores, names)
    held = [row for row in rows if "carried_mm" in row and row["seed"] == 1]
    for row in sorted(held, key=lambda row: -row["rmse_mm"] / min(row["carried_mm"], row["stay_mm"])):
        ratio = row["rmse_mm"] / min(row["carried_mm"], row["stay_mm"])
        others = f"carried {row['carried_mm']:6.1f}, stay {row['stay_mm']:6.1f}"
        print(f"{row['recording']:34s} {row['rmse_mm']:6.1f}, {others}, {ratio:.2f}")
    wrong, cost = np.mean([row["wrong"] for row in rows]), geometric(rows, "cpu_ms")
    print(f"{cost:.1f} ms of processor time a frame; reliable and over 50 mm wrong: {wrong:.1%} of the frames")


def summary(rows: list[dict]) -> list[dict]:
    """Rows by garment, of all garments at the end, view and condition: geometric mean of the RMSE, and means."""
    found = []
    for view, name in dict.fromkeys((row["view"], row["condition"]) for row in rows):
        mine = [row for row in rows if (row["view"], row["condition"]) == (view, name)]
        for garment in [*sorted({garment_of(row) for row in mine}), "all"]:
            chosen = [row for row in mine if garment in (garment_of(row), "all")]
            scored = {"rmse_mm": round(geometric(chosen, "rmse_mm"), 2), "runs": len(chosen)}
            scored |= {field: round(float(np.mean([row[field] for row in chosen])), 3) for field in ("reliability", "coverage")}
            found.append({"garment": garment, "view": view, "condition": name, **scored})
    return found


def tables(rows: list[dict]) -> None:
    """Prints the tables of a :func:`summary` in Markdown."""
    error = {(row["view"], row["garment"], row["condition"]): row["rmse_mm"] for row in rows}
    for view, title in TITLES.items():
        names = [name for name in CONDITIONS if (view, "all", name) in error]
        print(f"| RMSE mm, {title} | {' | '.join(names)} |\n|---{'|---' * len(names)}|")
        for garment in dict.fromkeys(row["garment"] for row in rows):
            print(f"| {garment} | {' | '.join(f'{error[view, garment, name]:.1f}' for name in names)} |")
        print()


def compare(rows: list[dict], others: list[dict]) -> None:
    """Prints the errors over those of other rows, and the runs that changed most."""
    before = {key_of(row): row for row in others}
    rows = [row | {f"x_{name}": row[name] / before[key_of(row)][name] for name in ("rmse_mm", "cpu_ms")} for row in rows
            if key_of(row) in before]  # fmt: skip
    print("\nerror over that of the other rows (geometric mean), worst run")
    worst = lambda chosen: max(row["x_rmse_mm"] for row in chosen)  # noqa: E731
    table(rows, lambda chosen: f"{geometric(chosen, 'x_rmse_mm'):.3f} {worst(chosen):.2f}", CONDITIONS)
    rows.sort(key=lambda row: row["x_rmse_mm"])
    for row in rows[:8] + rows[-12:]:
        old = before[key_of(row)]
        print(f"{', '.join(map(str, key_of(row))):64s} {old['rmse_mm']:6.1f} -> {row['rmse_mm']:6.1f} "
              f"reliability {old['reliability']:.2f} -> {row['reliability']:.2f}")  # fmt: skip
    print(f"all: error {geometric(rows, 'x_rmse_mm'):.3f}, processor time {geometric(rows, 'x_cpu_ms'):.3f}")


def add_recordings(parser: argparse.ArgumentParser) -> None:
    """The options that choose recordings."""
    parser.add_argument("--recordings", nargs="+", default=RECORDINGS, metavar="NAME", help="of the training split")
    parser.add_argument("--held-out", action="store_true", help="the held-out split, on which nothing may be chosen")


def recordings(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> list[str] | tuple[str, ...]:
    """The names of those that were chosen; ends the program where one is not in the training split."""
    if arguments.held_out:
        return [each.name for each in collection.listed(collection.HELD_OUT)]
    if unknown := set(arguments.recordings) - {each.name for each in collection.listed(collection.TRAINING)}:
        parser.error(f"not in the training split: {', '.join(sorted(unknown))}")
    return arguments.recordings


def main(argv: list[str] | None = None) -> int:
    """Runs and prints; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_recordings(parser)
    parser.add_argument("--views", nargs="+", default=VIEWS)
    parser.add_argument("--conditions", nargs="+", default=list(CONDITIONS), choices=list(CONDITIONS))
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--seeds", type=int, default=1, help="of the sensor's noise, of each run")
    parser.add_argument("--config", default="{}", metavar="JSON", help="of Config.from_dict")
    parser.add_argument("--procs", type=int, default=1)
    parser.add_argument("--out", type=Path, metavar="JSON", help="file for the rows")
    parser.add_argument("--against", type=Path, metavar="JSON", help="rows of another version")
    parser.add_argument("--json", type=Path, nargs="?", const=RESULT, metavar="FILE", help="file for the errors by garment")
    parser.add_argument("--table", action="store_true", help="print that file in Markdown, and track nothing")
    arguments = parsed(parser, argv, target="json")
    if arguments.table:
        tables(json.loads((arguments.json or RESULT).read_text())["rows"])
        return 0
    chosen, seeds = recordings(parser, arguments), range(1, arguments.seeds + 1)
    jobs = [
        (name, view, condition, arguments.frames, arguments.config, seed)
        for name, view, condition, seed in itertools.product(chosen, arguments.views, arguments.conditions, seeds)
        # one camera hides a side already
        if (condition != "hidden side" or view == "full") and (condition not in BODY_SD or view.endswith("+body"))
        and (condition not in CAMERAS_OFF or view == "ring4") and (condition not in SIZES or view != "front")
    ]
    with multiprocessing.get_context("spawn").Pool(arguments.procs) as pool:
        rows = []
        for row in pool.imap(run, jobs, chunksize=13):
            rows.append(row)
            print(f"{', '.join(map(str, key_of(row)))}: {scores([row])}", file=sys.stderr, flush=True)
    if arguments.out:
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")
    if arguments.json:
        head = {"commit": machine.commit(), "held_out": arguments.held_out, "seeds": arguments.seeds, "frames": arguments.frames}
        lines = ",\n".join(f"  {json.dumps(row)}" for row in summary(rows))
        arguments.json.write_text(f'{json.dumps(head)[:-1]}, "rows": [\n{lines}\n]}}\n')
    report(rows)
    if arguments.against:
        compare(rows, json.loads(arguments.against.read_text()))
    return 0


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

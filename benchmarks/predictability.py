"""Predictability of hidden cloth: ``python benchmarks/predictability.py [--recordings NAME ...] [--json [FILE]]``.

Held-out skirts, dresses and capes are simulated anew from a frame in which all is in motion, by the simulator that made them. It
is told the vertices in that frame, how far they have moved since the frame before, and in every frame the body and the vertices
that are sewn to it. It runs as it did for the recording, with each vertex 1 mm off, at rest at the start, with twice as many
time steps, and with another fabric. The tracker is not told how the vertices move at the start. Errors are those of the vertices
that it does not measure in the clip from one camera with the body, beside the tracker's own. Needs the extra ``simulation``; a
minute or two for each recording.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from pathlib import Path

import numpy as np
from committed import parsed
from conditions import FIRST, FRAMES, geometric

import ddakf
from ddakf.data.body import load_body
from ddakf.data.body_shape import random_shape, shaped
from ddakf.evaluation import machine
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.simulation import fabrics, garments, solver
from ddakf.evaluation.simulation.collection_plan import Entry, entries
from ddakf.evaluation.simulation.fabrics import Fabric
from ddakf.evaluation.simulation.simulated_recording import Order
from ddakf.files.sequence import Sequence

RESULT = Path(__file__).parent / "results/predictability.json"
GARMENTS = ("skirt", "straight-skirt", "dress", "cape")
SHIFT = 0.001  # m, standard deviation of each coordinate's error at the start
OTHER = {"cotton": "jersey"}  # fabric that takes another's place; cotton where none is listed
COLUMNS = ("simulated", "shifted", "at_rest", "other_steps", "other_fabric", "tracked")


def run(name: str) -> dict:
    """Errors at the hidden vertices of a clip, millimetres (RMSE), of the simulations and of the tracker."""
    sequence, order = collection.load(name), _order(name)
    numbers = range(FIRST, min(FIRST + FRAMES, len(sequence)))
    tracked, hidden = _tracked(sequence, numbers)
    truth = sequence.garment_vertices[numbers.start + 1 : numbers.stop].astype(np.float64)
    fabric, other = fabrics.FABRICS[order.fabric], fabrics.FABRICS[OTHER.get(order.fabric, "cotton")]
    noise = SHIFT * np.random.default_rng(1).normal(size=truth[0].shape)
    found = {
        "simulated": _simulated(sequence, order, numbers, fabric),
        "shifted": _simulated(sequence, order, numbers, fabric, noise=noise),
        "at_rest": _simulated(sequence, order, numbers, fabric, moving=False),
        "other_steps": _simulated(sequence, order, numbers, fabric, substeps=2 * order.substeps),
        "other_fabric": _simulated(sequence, order, numbers, other),
        "tracked": tracked,
    }
    row = {"recording": name, "fabric": order.fabric, "frames": len(truth), "hidden": round(float(np.mean(hidden)), 3)}
    return row | {column: round(_rmse_mm(found[column], truth, hidden), 2) for column in COLUMNS}


def _order(name: str) -> Order:
    """Parameters of a recording of the collection."""
    entry = next(entry for entry in entries() if entry.name == name)
    listed = next(each for each in collection.listed() if each.name == name)
    return Entry(entry.number, listed.seed - entry.seed).order


def _rmse_mm(vertices: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """Mean over the frames of the RMSE of (T, V, 3) at the vertices (T, V)."""
    squared = np.square(vertices - truth).sum(axis=2)
    return 1e3 * float(np.mean([np.sqrt(frame[mask].mean()) for frame, mask in zip(squared, where, strict=True)]))


def _simulated(
    sequence: Sequence,
    order: Order,
    numbers: range,
    fabric: Fabric,
    *,
    substeps: int | None = None,
    noise: np.ndarray | float = 0.0,
    moving: bool = True,
) -> np.ndarray:
    """(T, V, 3) metres: the garment after the first of these frames, as the simulator predicts it from there, ``noise`` off, and
    at rest there unless ``moving``."""
    before, at = sequence.garment_vertices[numbers.start - 1 : numbers.start + 1].astype(np.float64)
    body, clip = shaped(load_body(), random_shape(order.body)), slice(numbers.start, numbers.stop)
    garment = garments.make(order.garment, body, order.n_vertices, order.seed, order.fit)
    start = solver.Start(at + noise, (at - before) * sequence.fps * moving)
    # its pinned vertices are sewn to the body
    posed, pins = sequence.body_vertices[clip], sequence.garment_vertices[clip]
    steps = solver.Steps(substeps or order.substeps)
    frames = solver.simulate(garment, posed, sequence.body_faces, pins, sequence.fps, fabric, steps, start=start)
    return np.array(list(frames), np.float64)


def _tracked(sequence: Sequence, numbers: range) -> tuple[np.ndarray, np.ndarray]:
    """(T, V, 3) metres, as the tracker has it from one camera with the body, and (T, V) which vertices it did not measure."""
    body = ddakf.Mesh(sequence.body_vertices[numbers.start], sequence.body_faces)
    tracker = ddakf.Tracker(ddakf.Mesh(sequence.template, sequence.garment_faces), body=body)
    tracker.reset(vertices=sequence.garment_vertices[numbers.start])
    vertices, hidden = [], []
    for k in numbers[1:]:
        cloud = Sensor("front").capture(sequence, k, np.random.default_rng([1, k]))
        result = tracker.step(
            cloud.points, timestamp=k / sequence.fps, sensor_origin=cloud.sensor_origin, body_vertices=sequence.body_vertices[k]
        )
        vertices.append(result.vertices)
        hidden.append(~result.observed)
    return np.array(vertices), np.array(hidden)


def table(rows: list[dict]) -> str:
    """The errors in Markdown, by recording and in the geometric mean."""
    lines = ["| hidden cloth, RMSE mm | as recorded | 1 mm off | at rest | other steps | other fabric | DD-AKF |"]
    lines.append("|---" * (1 + len(COLUMNS)) + "|")
    lines += [f"| {row['recording']} | {' | '.join(f'{row[column]:.0f}' for column in COLUMNS)} |" for row in rows]
    return "\n".join([*lines, f"| all | {' | '.join(f'{geometric(rows, column):.0f}' for column in COLUMNS)} |"])


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", nargs="+", metavar="NAME", help="default: held-out skirts, dresses and capes")
    parser.add_argument("--procs", type=int, default=2)
    parser.add_argument("--json", type=Path, nargs="?", const=RESULT, metavar="FILE", help="file for the errors")
    parser.add_argument("--table", action="store_true", help="print that file in Markdown, and simulate nothing")
    arguments = parsed(parser, argv, target="json")
    if arguments.table:
        print(table(json.loads(RESULT.read_text())["rows"]))
        return 0
    names = arguments.recordings or [each.name for each in collection.listed(collection.HELD_OUT) if each.garment in GARMENTS]
    rows = []
    with multiprocessing.get_context("spawn").Pool(arguments.procs) as pool:
        for done, row in enumerate(pool.imap(run, names), start=1):
            rows.append(row)
            print(f"{done} of {len(names)}: {row}", file=sys.stderr, flush=True)
    if arguments.json:
        content = {"commit": machine.commit(), "machine": machine.describe(), "rows": rows}
        arguments.json.write_text(json.dumps(content, indent=1) + "\n")
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())

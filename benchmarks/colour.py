"""Colours of the cloud: textured garments tracked with and without them, ``python benchmarks/colour.py [--out ROWS.json]``.

Clips of training recordings get a texture, a light and a camera's noise, and are tracked twice from the same points: without
their colours and with them. Compared are the errors of seen vertices along the surface and across it, the RMSE, and the share of
seen vertices in their 90 % ellipsoids. ``--held-out`` tracks the held-out recordings instead, on which nothing was chosen.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np
from committed import parsed
from conditions import FIRST, INSIDE, add_recordings, garment_of, geometric, recordings
from scipy.spatial.transform import Rotation

import ddakf
from ddakf.evaluation import machine
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors.texture import Texture
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.files.sequence import Sequence
from ddakf.kernels.normals import vertex_normals

VIEWS = ("full", "front+body")
FRAMES = 60
TEXTURES = {
    "print": Texture("print"),
    "checks": Texture("checks"),
    "stripes": Texture("stripes"),
    "strong shading": Texture("print", ambient=0.15, exposure=0.2),
    "plain": Texture("plain"),
    "plain, strong shading": Texture("plain", ambient=0.15, exposure=0.2),
}
NAMES = {"full": "all around", "front+body": "one camera, body", "front": "one camera"}
FIELDS = ("tangential_mm", "normal_mm", "rmse_mm")


def run(job: tuple[str, str, tuple[str, ...], int, str, float]) -> list[dict]:
    """The rows of a recording in a view, one per texture: errors without colours, and with them (``colour_``)."""
    name, view, textures, frames, config, turned = job
    sequence, (side, _, with_body) = collection.load(name), view.partition("+")
    body = ddakf.Mesh(sequence.body_vertices[FIRST], sequence.body_faces) if with_body else None
    garment = ddakf.Mesh(sequence.template, sequence.garment_faces)
    tracker = ddakf.Tracker(garment, body=body, config=ddakf.Config.from_dict(json.loads(config)))
    # the cloud of the start comes first, so that the colours are learned where the garment is known
    numbers = range(FIRST, min(FIRST + 1 + frames, len(sequence)))

    def tracked(texture: Texture | None) -> dict[str, float]:
        tracker.reset(vertices=about_vertical(sequence.garment_vertices[FIRST], turned))
        score = Scores(sequence)
        for k in numbers:
            cloud = Sensor(side).capture(sequence, k, np.random.default_rng([1, k]), texture)
            pose, before = sequence.body_vertices[k] if with_body else None, time.thread_time()
            result = tracker.step(
                cloud.points,
                timestamp=k / sequence.fps,
                sensor_origin=cloud.sensor_origin,
                body_vertices=pose,
                colors=None if texture is None else cloud.colors,
            )
            if k > FIRST:
                score.add(result, k, time.thread_time() - before)
        return score.summary()

    without = tracked(None)
    rows = []
    for texture in textures:
        coloured = tracked(TEXTURES[texture])
        row = {"recording": name, "view": view, "texture": texture, "frames": len(numbers) - 1}
        for prefix, found in (("", without), ("colour_", coloured)):
            row |= {f"{prefix}{key}": None if np.isnan(value) else float(f"{value:.4g}") for key, value in found.items()}
        rows.append(row)
    return rows


def about_vertical(vertices: np.ndarray, degrees: float) -> np.ndarray:
    """(V, 3) vertices turned about the vertical through their mean."""
    if degrees == 0:
        return vertices  # to the bit
    turn, middle = Rotation.from_euler("y", degrees, degrees=True), vertices.mean(axis=0)
    return turn.apply(vertices - middle) + middle


class Scores:
    """Errors of a run."""

    def __init__(self, sequence: Sequence):
        self.sequence, self.rows = sequence, []
        self.faces = sequence.garment_faces.astype(np.int32)

    def add(self, result: ddakf.FrameResult, frame: int, seconds: float) -> None:
        """Adds a frame of the recording."""
        truth = np.asarray(self.sequence.garment_vertices[frame], np.float64)
        off, seen, normal = result.vertices - truth, result.observed, np.empty_like(truth)
        vertex_normals(truth, self.faces, normal)
        squared, along = np.square(off).sum(axis=1), np.square(np.einsum("va,va->v", off, normal))
        inside = np.einsum("va,va->v", off, np.linalg.solve(result.covariance, off[:, :, None])[:, :, 0]) < INSIDE
        mean = lambda values, where: values[where].mean() if where.any() else np.nan  # noqa: E731
        self.rows.append(
            {
                "tangential_mm": 1e3 * np.sqrt(mean(squared - along, seen)),
                "normal_mm": 1e3 * np.sqrt(mean(along, seen)),
                "rmse_mm": 1e3 * np.sqrt(squared.mean()),
                "hidden_mm": 1e3 * np.sqrt(mean(squared, ~seen)),
                "coverage": mean(inside, seen),
                "hidden_coverage": mean(inside, ~seen),
                "reliability": result.reliability,
                "cpu_ms": 1e3 * seconds,
            }
        )

    def summary(self) -> dict[str, float]:
        """Means over the frames; of the time the median."""
        found = {name: np.array([row[name] for row in self.rows]) for name in self.rows[0]}
        return {name: float(np.median(v) if name == "cpu_ms" else np.nanmean(v)) for name, v in found.items()}


def table(rows: list[dict], column: str) -> list[str]:
    """Lines of a table in Markdown by view and ``column``: geometric means without colours and with them."""
    lines = [f"| {column} | along the surface, mm | across it, mm | RMSE, mm | seen in ellipsoids | ms |", "|---" * 6 + "|"]
    for view, name in dict.fromkeys((row["view"], row[column]) for row in rows):
        mine = [row for row in rows if (row["view"], row[column]) == (view, name)]
        cells = []
        for field in FIELDS:
            before, after = geometric(mine, field), geometric(mine, f"colour_{field}")
            cells.append(f"{before:.1f}, {after:.1f} ({after / before:.2f})")
        cells.append("{:.0%}, {:.0%}".format(*(np.mean([row[f"{p}coverage"] for row in mine]) for p in ("", "colour_"))))
        cells.append("{:.0f}, {:.0f}".format(*(geometric(mine, f"{p}cpu_ms") for p in ("", "colour_"))))
        lines.append(f"| {' | '.join([f'{NAMES[view]}, {name}', *cells])} |")
    return lines


def report(rows: list[dict]) -> None:
    """Prints the tables by texture, and by garment with the print."""
    print("\n".join(table(rows, "texture")), end="\n\n")
    print("\n".join(table([row | {"garment": garment_of(row)} for row in rows if row["texture"] == "print"], "garment")))


def write(path: Path, split: str, rows: list[dict]) -> None:
    """Writes the rows of a split into a file, with the commit; those of the other split stay."""
    splits = json.loads(path.read_text()) if path.is_file() else {}
    splits |= {split: {"commit": machine.commit(), "rows": rows}}
    parts = []
    for name, found in splits.items():
        lines = ",\n".join(map(json.dumps, found["rows"]))
        parts.append(f'{json.dumps(name)}: {{"commit": {json.dumps(found["commit"])}, "rows": [\n{lines}\n]}}')
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n")


def main(argv: list[str] | None = None) -> int:
    """Runs and prints; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_recordings(parser)
    parser.add_argument("--views", nargs="+", default=VIEWS)
    parser.add_argument("--textures", nargs="+", default=list(TEXTURES), choices=list(TEXTURES))
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--turned", type=float, default=0.0, metavar="DEGREES", help="of the start, about the vertical")
    parser.add_argument("--config", default="{}", metavar="JSON", help="of Config.from_dict")
    parser.add_argument("--procs", type=int, default=1)
    parser.add_argument("--out", type=Path, metavar="JSON", help="file for the rows, beside those of the other split")
    parser.add_argument("--show", type=Path, metavar="JSON", help="print the tables of such a file, and track nothing")
    arguments = parsed(parser, argv)
    if arguments.show:
        for split, found in json.loads(arguments.show.read_text()).items():
            print(f"\n{split}, {found['commit']}\n")
            report(found["rows"])
        return 0
    chosen = recordings(parser, arguments)
    constant = [tuple(arguments.textures)], [arguments.frames], [arguments.config], [arguments.turned]
    jobs = itertools.product(chosen, arguments.views, *constant)
    with multiprocessing.get_context("spawn").Pool(arguments.procs) as pool:
        rows = []
        for found in pool.imap(run, jobs):
            rows += found
            for row in found:
                errors = " ".join(f"{row[name]:.1f} -> {row['colour_' + name]:.1f}," for name in FIELDS)
                print(f"{row['recording']}, {row['view']}, {row['texture']}: {errors}", file=sys.stderr, flush=True)
            if arguments.out:  # what is finished, should the rest be interrupted
                write(arguments.out, collection.HELD_OUT if arguments.held_out else collection.TRAINING, rows)
    report(rows)
    return 0


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

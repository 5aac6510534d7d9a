"""Templates of few vertices, with and without split edges: ``python benchmarks/coarse_templates.py [--held-out] [--procs N]``.

Clips of recordings are tracked with templates of 500, 250 and 120 of their vertices, joined where the geodesic Voronoi regions of
these meet, on the working mesh of the default configuration and on the template itself; the clouds are those of the whole
recording. Printed by view and number of vertices are the RMSE over the template's vertices, their share in the 90 % ellipsoids,
and the reliability. ``--held-out`` tracks the recordings on which nothing was chosen. Writes
benchmarks/results/coarse_templates.json unless ``--out`` says otherwise; ``--table`` prints the table of docs/evaluation.md.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from pathlib import Path

import clips
import numpy as np
from conditions import FIRST, INSIDE
from inputs import resampled
from other_triangles import VIEWS

import ddakf
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors import Sensor
from ddakf.files.sequence import Sequence

RESULT = Path(__file__).parent / "results" / "coarse_templates.json"
COUNTS = (500, 250, 120)  # vertices, about
DEFAULT = ddakf.Config()
COARSEST = {
    "split": DEFAULT,
    "not split": replace(DEFAULT, discretisation=replace(DEFAULT.discretisation, working_coarsest=1000.0)),
}


def run(job: tuple[str, tuple[str, int], int]) -> list[dict]:
    """The rows of a recording's name, a view with a number of vertices, and a number of frames: one per configuration."""
    name, (view, count), frames = job
    original = collection.load(name)
    coarse, rows = resampled(original, count), []
    for title, config in COARSEST.items():
        row = {"recording": name, "view": view, "vertices": count, "template": title}
        rows.append(row | _errors(original, coarse, view, frames, config))
    return rows


def _errors(original: Sequence, coarse: Sequence, view: str, frames: int, config: ddakf.Config) -> dict:
    """Means over the frames, and the number of vertices that are tracked."""
    side, _, with_body = view.partition("+")
    body = ddakf.Mesh(original.body_vertices[FIRST], original.body_faces) if with_body else None
    tracker, found = ddakf.Tracker(ddakf.Mesh(coarse.template, coarse.garment_faces), body=body, config=config), []
    tracker.reset(coarse.garment_vertices[FIRST])
    for k in range(FIRST + 1, min(FIRST + 1 + frames, len(original))):
        points, origin = Sensor(side).capture(original, k, np.random.default_rng([1, k]))
        pose = original.body_vertices[k] if with_body else None
        result = tracker.step(points, timestamp=k / original.fps, sensor_origin=origin, body_vertices=pose)
        off = result.vertices - coarse.garment_vertices[k]
        squared = np.einsum("va,va->v", off, np.linalg.solve(result.covariance, off[:, :, None])[:, :, 0])
        rmse = 1e3 * np.sqrt(np.square(off).sum(axis=1).mean())
        found.append((rmse, (squared < INSIDE).mean(), result.reliability))
    means = dict(zip(("rmse_mm", "coverage", "reliability"), np.round(np.mean(found, axis=0), 4).tolist(), strict=True))
    return means | {"tracked": tracker.working_vertices}


def table(rows: list[dict]) -> list[str]:
    """Lines in Markdown: geometric means of the RMSE, and means of coverage and reliability."""
    columns, lines = list(itertools.product(VIEWS, COARSEST)), []
    for count in COUNTS:
        of_count = [row for row in rows if row["vertices"] == count]
        chosen = ([row for row in of_count if (row["view"], row["template"]) == column] for column in columns)
        lines.append([str(count), *map(clips.scores, chosen)])
    return clips.markdown(["vertices", *(f"{VIEWS[view]}: {title}" for view, title in columns)], lines)


def main(argv: list[str] | None = None) -> int:
    """Runs and prints; returns the exit status."""
    return clips.main(argv, __doc__.splitlines()[0], RESULT, run, list(itertools.product(VIEWS, COUNTS)), table)


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

"""Templates of other triangles than the cloud's surface: ``python benchmarks/other_triangles.py [--held-out] [--procs N]``.

A simulated cloud lies on the triangles of its recording. A template of the same triangles feels each of their edges as a fold
that goes with the cloth, which no real camera sees. Clips of training recordings are tracked with the recording's own template,
with one whose quadrangles have their other diagonals, and with one whose edges are halved: the same vertices, or the same
surface, and the same clouds. Printed by garment and view are the RMSE, the share of the true vertices in the 90 % ellipsoids and
the reliability. ``--held-out`` tracks the held-out recordings instead, on which nothing was chosen. Writes
benchmarks/results/other_triangles.json unless ``--out`` says otherwise; ``--table`` prints the table of docs/evaluation.md.
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import replace
from pathlib import Path

import clips
import numpy as np
from conditions import FIRST, INSIDE, geometric
from triangulations import subdivided

import ddakf
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors import Sensor
from ddakf.files.sequence import Sequence

RESULT = Path(__file__).parent / "results" / "other_triangles.json"
VIEWS = {"full": "all around", "front": "one camera", "front+body": "one camera, body"}
ROUNDS = 2  # of diagonals
FLAT = 0.2  # cosine between a face before and after, at least


def other_diagonals(sequence: Sequence) -> Sequence:
    """The recording with another template: most of the pairs of triangles have the other diagonal of their quadrangle."""
    mesh, rng = ddakf.Mesh(sequence.template, sequence.garment_faces), np.random.default_rng(0)
    for _ in range(ROUNDS):
        mesh = _swapped(mesh, rng)
    return replace(sequence, garment_faces=mesh.faces.astype(sequence.garment_faces.dtype))


def _swapped(mesh: ddakf.Mesh, rng: np.random.Generator) -> ddakf.Mesh:
    """The mesh with as many diagonals swapped as there are pairs of triangles, taken in random order."""
    faces, place = mesh.faces.copy(), mesh.vertices
    known, beside = set(map(tuple, mesh.edges.tolist())), {}
    for face, corners in enumerate(faces.tolist()):
        for k in range(3):
            beside[corners[k], corners[(k + 1) % 3]] = face, corners[(k + 2) % 3]
    used = np.zeros(len(faces), bool)
    for a, b in mesh.edges[rng.permutation(len(mesh.edges))].tolist():
        if (a, b) not in beside or (b, a) not in beside:
            continue
        (one, c), (other, d) = beside[a, b], beside[b, a]
        before = np.cross(place[b] - place[a], place[c] - place[a])
        after = np.cross(place[d] - place[a], place[c] - place[a]), np.cross(place[b] - place[d], place[c] - place[d])
        flat = all(normal @ before > FLAT * (before @ before) for normal in after)
        if flat and not (used[one] or used[other]) and (min(c, d), max(c, d)) not in known:
            faces[one], faces[other] = (a, d, c), (d, b, c)
            used[[one, other]] = True
            known.add((min(c, d), max(c, d)))
    return ddakf.Mesh(place, faces)


TEMPLATES = {"own": lambda s: s, "other diagonals": other_diagonals, "halved edges": lambda s: subdivided(s, 1)}


def run(job: tuple[str, str, int]) -> list[dict]:
    """The rows of a recording in a view, of so many frames, one per template."""
    name, view, frames = job
    original, (side, _, with_body) = collection.load(name), view.partition("+")
    n, rows = original.garment_vertices.shape[1], []
    body = ddakf.Mesh(original.body_vertices[FIRST], original.body_faces) if with_body else None
    for title, change in TEMPLATES.items():
        sequence, found = change(original), []
        tracker = ddakf.Tracker(ddakf.Mesh(sequence.template, sequence.garment_faces), body=body)
        tracker.reset(vertices=sequence.garment_vertices[FIRST])
        for k in range(FIRST + 1, min(FIRST + 1 + frames, len(original))):
            points, origin = Sensor(side).capture(original, k, np.random.default_rng([1, k]))
            pose = original.body_vertices[k] if with_body else None
            result = tracker.step(points, timestamp=k / original.fps, sensor_origin=origin, body_vertices=pose)
            off = result.vertices[:n] - original.garment_vertices[k]  # the first vertices are the recording's
            squared = np.einsum("va,va->v", off, np.linalg.solve(result.covariance[:n], off[:, :, None])[:, :, 0])
            rmse = 1e3 * np.sqrt(np.square(off).sum(axis=1).mean())
            found.append((rmse, result.reliability, (squared < INSIDE).mean()))
        means = zip(("rmse_mm", "reliability", "coverage"), np.mean(found, axis=0), strict=True)
        row = {"recording": name, "garment": name.partition("_")[0], "view": view, "template": title}
        rows.append(row | {key: round(float(value), 4) for key, value in means})
    return rows


def table(rows: list[dict]) -> list[str]:
    """Lines of a table in Markdown: geometric means of the RMSE, and means of coverage and reliability."""
    heads = [f"{VIEWS[view]}: {template}" for view in VIEWS for template in TEMPLATES]
    lines = [f"| | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    for garment in (*sorted({row["garment"] for row in rows}), None):
        cells = ["all" if garment is None else garment]
        for view, template in itertools.product(VIEWS, TEMPLATES):
            mine = [row for row in rows if (row["view"], row["template"]) == (view, template)]
            mine = [row for row in mine if garment in (None, row["garment"])]
            inside, reliable = (np.mean([row[key] for row in mine]) for key in ("coverage", "reliability"))
            cells.append(f"{geometric(mine, 'rmse_mm'):.1f}, {inside:.0%}, {reliable:.2f}")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main(argv: list[str] | None = None) -> int:
    """Runs and prints; returns the exit status."""
    return clips.main(argv, __doc__.splitlines()[0], RESULT, run, VIEWS, table)


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

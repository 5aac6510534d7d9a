"""Templates of other triangles than the cloud's surface: ``python benchmarks/other_triangles.py [--held-out] [--procs N]``.

A simulated cloud lies on the triangles of its recording. A template of the same triangles feels each of their edges as a fold
that goes with the cloth, which no real camera sees. Clips of training recordings are tracked with the recording's own template,
with one whose quadrangles have their other diagonals, and with one whose edges are halved: the same vertices, or the same
surface, and the same clouds. Printed by garment and view are the RMSE, the share of the true vertices in the 90 % ellipsoids and
the reliability; then the RMSE beside those of the two best baselines, which get no template of halved edges, whose fourfold
vertices their settings are not made for. ``--held-out`` tracks the held-out recordings instead, on which nothing was chosen.
Writes benchmarks/results/other_triangles.json unless ``--out`` says otherwise; ``--table`` prints the tables of
docs/evaluation.md.
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
from ddakf.evaluation.sensors import CapturedFrame, Sensor
from ddakf.evaluation.trials.methods import method_factory
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


OWN, DIAGONALS = itertools.islice(TEMPLATES, 2)
METHODS = {"ddakf": "DD-AKF", "nicp": "non-rigid ICP (ARAP)", "opt-ed": "Opt-ED"}


def run(job: tuple[str, tuple[str, str], int]) -> list[dict]:
    """The rows of a recording in a view, by a method, of so many frames: one per template."""
    name, (view, method), frames = job
    original, (side, _, with_body) = collection.load(name), view.partition("+")
    n, rows = original.garment_vertices.shape[1], []
    body = ddakf.Mesh(original.body_vertices[FIRST], original.body_faces) if with_body else None
    for title in TEMPLATES if method == "ddakf" else (OWN, DIAGONALS):
        sequence, found = TEMPLATES[title](original), []
        garment, start = ddakf.Mesh(sequence.template, sequence.garment_faces), sequence.garment_vertices[FIRST]
        step = method_factory(method)(garment, start, body)
        for k in range(FIRST + 1, min(FIRST + 1 + frames, len(original))):
            points, origin = Sensor(side).capture(original, k, np.random.default_rng([1, k]))
            pose = original.body_vertices[k] if with_body else None
            estimate, truth = step(CapturedFrame(k, k / original.fps, points, origin, pose)), original.garment_vertices[k]
            off = estimate.vertices[:n] - truth  # the first vertices are the recording's
            said = {"rmse_mm": 1e3 * np.sqrt(np.square(off).sum(axis=1).mean())}
            if estimate.covariance is not None:
                squared = np.einsum("va,va->v", off, np.linalg.solve(estimate.covariance[:n], off[:, :, None])[:, :, 0])
                said |= {"reliability": estimate.reliability, "coverage": (squared < INSIDE).mean()}
            found.append(said)
        row = {"recording": name, "garment": name.partition("_")[0], "view": view, "method": method, "template": title}
        rows.append(row | {key: round(float(np.mean([each[key] for each in found])), 4) for key in found[0]})
    return rows


def table(rows: list[dict]) -> list[str]:
    """Lines of two tables in Markdown, see :func:`of_garments` and :func:`of_methods`."""
    return [*of_garments([row for row in rows if row["method"] == "ddakf"]), "", *of_methods(rows)]


def of_garments(rows: list[dict]) -> list[str]:
    """Lines of a table of the tracker: geometric means of the RMSE, and means of coverage and reliability."""
    columns, lines = list(itertools.product(VIEWS, TEMPLATES)), []
    for garment in (*sorted({row["garment"] for row in rows}), None):
        of_garment = [row for row in rows if garment in (None, row["garment"])]
        chosen = ([row for row in of_garment if (row["view"], row["template"]) == column] for column in columns)
        lines.append([garment or "all", *map(clips.scores, chosen)])
    return clips.markdown(["", *(f"{VIEWS[view]}: {template}" for view, template in columns)], lines)


def of_methods(rows: list[dict]) -> list[str]:
    """Lines of a table of all methods: geometric means of the RMSE."""
    columns, lines = list(itertools.product(VIEWS, (OWN, DIAGONALS))), []
    for method, title in METHODS.items():
        of_method = [row for row in rows if row["method"] == method]
        chosen = ([row for row in of_method if (row["view"], row["template"]) == column] for column in columns)
        lines.append([title, *(f"{geometric(mine, 'rmse_mm'):.1f}" for mine in chosen)])
    return clips.markdown(["", *(f"{VIEWS[view]}: {title}" for view, title in columns)], lines)


def main(argv: list[str] | None = None) -> int:
    """Runs and prints; returns the exit status."""
    return clips.main(argv, __doc__.splitlines()[0], RESULT, run, list(itertools.product(VIEWS, METHODS)), table)


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

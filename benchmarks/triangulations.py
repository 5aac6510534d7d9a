"""Error and time of other triangulations of the same garment: ``python benchmarks/triangulations.py [--frames N] [--only NAME]``.

Each recording is tracked with its own template, with the template subdivided twice, and with half of its faces split at their
centre, from all around and from one camera with the body; with the working mesh, and without (``--without``, slow). The sensor
sees the recording as it is, so that all rows of a recording and view get the same clouds.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import inputs
import numpy as np
from committed import parsed
from library import WARM

import ddakf
from ddakf.evaluation import machine
from ddakf.files.sequence import Sequence

RESULT = Path(__file__).parent / "results/triangulations.json"
VIEWS = (("full", False), ("front", True))
CHI2_90 = 6.251  # of three dimensions


def subdivided(sequence: Sequence, times: int = 2) -> Sequence:
    """Each edge halved, so many times."""
    for _ in range(times):
        faces, n = sequence.garment_faces, sequence.garment_vertices.shape[1]
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        edges, number = np.unique(sides, axis=0, return_inverse=True)
        (a, b, c), (p, q, r) = faces.T, n + number.reshape(-1, 3).T
        corners = [np.stack(face, axis=1) for face in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
        sequence = inputs.replaced(sequence, lambda v, e=edges: _extended(v, v[..., e, :]), np.concatenate(corners))
    return sequence


def centre_split(sequence: Sequence) -> Sequence:
    """Half of the faces split at their centre."""
    faces, n = sequence.garment_faces, sequence.garment_vertices.shape[1]
    rows = np.random.default_rng(inputs.SEED).permutation(len(faces))[: len(faces) // 2]
    (a, b, c), centre = faces[rows].T, n + np.arange(len(rows))
    corners = [np.stack(face, axis=1) for face in ((a, b, centre), (b, c, centre), (c, a, centre))]
    faces = np.concatenate([np.delete(faces, rows, axis=0), *corners])
    return inputs.replaced(sequence, lambda v: _extended(v, v[..., sequence.garment_faces[rows], :]), faces)


def _extended(vertices: np.ndarray, corners: np.ndarray) -> np.ndarray:
    return np.concatenate([vertices, corners.mean(axis=-2)], axis=-2)


TEMPLATES = {"own": lambda sequence: sequence, "subdivided twice": subdivided, "half split": centre_split}


def row(run: inputs.Run, sequence: Sequence, template: str, config: ddakf.Config) -> dict:
    """One recording, view and template: errors, processor time and coverage of the 90 % ellipsoids of seen vertices."""
    run = replace(run, sequence=sequence)
    tracker, errors, seconds, inside = run.tracker(config), [], [], []
    for number, cloud, how in run.frames():
        begun = time.process_time()
        result = tracker.step(cloud.points, **how)
        seconds.append(time.process_time() - begun)
        off = (result.vertices - sequence.garment_vertices[number])[:, :, None]
        errors.append(float(np.sqrt(np.square(off).sum(axis=(1, 2)).mean())))
        seen = result.observed
        inside.append((off[seen] * np.linalg.solve(result.covariance[seen], off[seen])).sum(axis=(1, 2)) < CHI2_90)
    return {
        "recording": run.name,
        "template": template,
        "vertices": tracker.garment.n_vertices,
        "working_mesh": config.discretisation.working_edge > 0,
        "rmse_mm": round(1e3 * float(np.mean(errors)), 2),
        "cpu_ms": round(1e3 * float(np.median(seconds[WARM:])), 1),
        "seen_in_90": round(float(np.concatenate(inside).mean()), 3),
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--points", type=int, default=10_000)
    parser.add_argument("--only", nargs="+", help="names of recordings, default: the sample and those of DDAKF_DATA with a body")
    parser.add_argument("--without", action="store_true", help="also without the working mesh")
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parsed(parser, argv)
    config = ddakf.Config()
    without = replace(config, discretisation=replace(config.discretisation, working_edge=0.0))
    configs, rows = (config, without) if arguments.without else (config,), []
    for sequence in inputs.sequences():
        if sequence.body_vertices is None or (arguments.only and sequence.name not in arguments.only):
            continue
        sequence = inputs.shortened(sequence, arguments.frames)
        templates = {name: change(sequence) for name, change in TEMPLATES.items()}
        for view, body in VIEWS:
            run = inputs.run_of(sequence, arguments.frames, view, arguments.points, body=body)
            for name, changed in templates.items():
                for chosen in configs:
                    rows.append(row(run, changed, name, chosen))
                    print(*rows[-1].values(), sep="  ", flush=True)
    report = {"machine": machine.describe(), "commit": machine.commit(), "frames": arguments.frames, "rows": rows}
    arguments.out.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

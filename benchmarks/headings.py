"""Garments that nobody has placed: ``python benchmarks/headings.py [--procs 2] [--json FILE]``.

The template of every recording of the collection stands half a metre off and faces another way than the wearer. The tracker gets
three frames, and no start. Prints by split, view and turn how many garments are found, with an RMSE below 60 mm, how many of the
others claim a reliability over 0.5, the median RMSE, and the time of the frame that searches; in brackets, how many had the
warning of an uncertain heading. The cloud is of the garment alone, or with ``--cloud`` of the whole person.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np
from committed import parsed
from inputs import TEXTURES

import ddakf
from ddakf.data.rotation import rotation_matrices
from ddakf.evaluation import machine
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors.virtual_sensor import Sensor

VIEWS, TURNS = {"full": "all around", "front": "one camera"}, (0, 90, 180, 270)  # degrees about the vertical
FIRST = (5, 40, 80)  # frame of a recording, by its place in the list
FRAMES, ASIDE, FOUND = 3, np.array([0.5, 0.0, 0.3]), 0.06  # m


def run(job: tuple[str, str, int, str, str]) -> list[dict]:
    """A recording seen from a view, its template in every heading: RMSE after the last frame, and the first frame's time."""
    name, view, first, changes, of = job
    sequence, sensor, rows = collection.load(name), Sensor(view, segmented=of == "garment"), []
    config = ddakf.Config.from_dict(json.loads(changes))
    for degrees in TURNS:
        turned = sequence.template @ rotation_matrices([0.0, np.radians(degrees), 0.0]).T + ASIDE
        tracker, times, warned = ddakf.Tracker(ddakf.Mesh(turned, sequence.garment_faces), config=config), [], False
        for k in range(first, first + FRAMES):
            cloud = sensor.capture(sequence, k, np.random.default_rng([1, k]), TEXTURES[of])
            how = {"sensor_origin": cloud.sensor_origin, "colors": getattr(cloud, "colors", None)}
            before = time.thread_time()
            result = tracker.step(cloud.points, timestamp=sequence.timestamp(k), **how)
            times.append(time.thread_time() - before)
            warned |= "heading_uncertain" in {warning.code for warning in result.warnings}
        rmse = np.sqrt(np.square(result.vertices - sequence.garment_vertices[k]).sum(axis=1).mean())
        row = {"recording": name, "view": view, "degrees": degrees, "rmse_mm": round(1e3 * float(rmse), 1)}
        row |= {"reliability": round(result.reliability, 3), "warned": warned, "first_ms": round(1e3 * times[0], 1)}
        rows.append(row)
    return rows


def table(rows: list[dict]) -> str:
    """Markdown: found, lost with a reliability over 0.5, median RMSE and time, by split, view and turn."""
    split = {each.name: each.split for each in collection.listed()}
    lines = ["| recordings | view | turned by | found | lost, reliability over 0.5 | median RMSE, mm | first frame, ms |",
             "|---|---|---|---|---|---|---|"]  # fmt: skip
    for name in collection.SPLITS:
        for view, title in VIEWS.items():
            for degrees in TURNS:
                mine = [r for r in rows if (split[r["recording"]], r["view"], r["degrees"]) == (name, view, degrees)]
                if not mine:
                    continue
                found, lost = ([r for r in mine if (r["rmse_mm"] < 1e3 * FOUND) is each] for each in (True, False))
                sure = [r for r in lost if r["reliability"] > 0.5]
                median, ms = (np.median([r[key] for r in mine]) for key in ("rmse_mm", "first_ms"))
                found, sure = (f"{len(each)} ({sum(r['warned'] for r in each)})" for each in (found, sure))
                lines.append(f"| {name} | {title} | {degrees}° | {found} of {len(mine)} | {sure} | {median:.0f} | {ms:.0f} |")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--procs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only these recordings")
    parser.add_argument("--split", choices=collection.SPLITS, help="only the recordings of this split")
    parser.add_argument("--cloud", choices=list(TEXTURES), default="garment", help="what the clouds are of")
    parser.add_argument("--config", default="{}", metavar="JSON", help="of Config.from_dict")
    parser.add_argument("--json", type=Path, metavar="FILE", help="of the rows")
    arguments = parsed(parser, argv, target="json")
    names = [each.name for each in collection.listed(arguments.split) if not arguments.only or each.name in arguments.only]
    how = arguments.config, arguments.cloud
    jobs = [(name, view, FIRST[k % len(FIRST)], *how) for k, name in enumerate(names) for view in VIEWS]
    rows: list[dict] = []
    with multiprocessing.get_context("spawn").Pool(arguments.procs) as pool:
        for done, found in enumerate(pool.imap(run, jobs), start=1):
            rows += found
            print(f"{done} of {len(jobs)} runs", end="\r" if done < len(jobs) else "\n", file=sys.stderr, flush=True)
    if arguments.json:
        meta = {"commit": machine.commit(), "machine": machine.describe(), "found_mm": 1e3 * FOUND}
        lines = ",\n".join("  " + json.dumps(row) for row in rows)
        arguments.json.write_text(f'{{\n "meta": {json.dumps(meta)},\n "rows": [\n{lines}\n ]\n}}\n')
    print(table(rows))
    return 0


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

"""Error, time and lines of the tracker's parts: ``python benchmarks/parts.py [--seeds 5] [--procs 2] [--out FILE]``.

Clips of training recordings (see :mod:`conditions`) are tracked by the default and by it without each of its parts, in three
views and with several seeds of the noise; the parts that are about low rates also at 10 frames per second. Their templates are
coarse. The sample and the tuned recordings of DDAKF_DATA, those that are there, have fine ones, and some stretch: they stand
apart. Printed are errors and processor times over those of the default, and the lines of the modules that are of that part alone.
Rows of ``--out`` that this commit has left are not run again. Writes benchmarks/results/parts.json, from which ``--table`` prints
the table.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from committed import parsed
from conditions import FRAMES, VIEWS, geometric, key_of, run
from rich.console import Console
from rich.progress import track

import ddakf
from ddakf.evaluation import machine
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.trials import variants
from ddakf.evaluation.trials.recordings import find_recording, recording_names

RESULT, ROWS = Path(__file__).parent / "results/parts.json", Path("out/parts.jsonl")
EVERY = 2  # every so-many-th training recording
FINE = ("sample", "pergamo_005", "samba_dress", "samba_whole", "sim_skirt_dance", "sim_tank_move", "sim_tshirt_jump")
PLAIN, SLOWLY, FINELY = "plain", "10 fps", "fine templates"  # conditions of a row
SLOW = ("default", "one-association", "no-clusters")  # also at 10 frames per second
WITH_BODY, WITHOUT = ("no-carrying", "no-holding"), ("no-following", "no-hidden-edge")  # others have no such part
CODE = Path(ddakf.__file__).parent
MODULES = {
    "no-clusters": ("multiresolution/cluster_alignment.py", "kernels/cluster_alignment.py"),
    "no-hems": ("kernels/hem.py",),
    "no-holding": ("body/body_anchor.py",),
    "no-following": ("multiresolution/hidden_cloth.py", "kernels/hidden_cloth.py"),
    "no-weight": ("body/gravity.py",),
    "no-visibility": ("kernels/visibility.py",),
}
FIELDS = ("rmse_mm", "cpu_ms")


def configurations() -> dict[str, ddakf.Config]:
    """The default, and the default without each part."""
    default = ddakf.Config()
    return {
        "default": default,
        **variants.ablations(),
        **variants.refinements(),
        "no-bulge": replace(default, associate=replace(default.associate, bulge=0.0)),
        "no-points": replace(default, associate=replace(default.associate, points=0)),
        "no-hidden-edge": replace(default, physics=replace(default.physics, hidden_edge=0.0)),
        "no-coarse-edge": replace(default, physics=replace(default.physics, coarse_share=1.0)),
    }


def lines(part: str) -> int | None:
    """Lines of the modules that are of the part alone, without blank ones; None where it has no module of its own."""
    files = [CODE / name for name in MODULES.get(part, ())]
    return sum(bool(line.strip()) for file in files for line in file.read_text().splitlines()) if files else None


def job_key(row: dict) -> tuple:
    return row["part"], *key_of(row)


def tracked(job: tuple[str, tuple]) -> dict:
    """A row of :func:`conditions.run`, and its part."""
    part, arguments = job
    return {"part": part, **run(arguments)}


def jobs(names: Iterable[str], seeds: int) -> list[tuple[str, tuple]]:
    """All runs, those of a recording and view together, so that a process loads it once."""
    texts = {part: json.dumps(config.to_dict()) for part, config in configurations().items()}
    found = []
    for name, view, (part, text), condition in itertools.product(names, VIEWS, texts.items(), (PLAIN, SLOWLY)):
        if (part in WITHOUT or not find_recording(name).has_body) if "body" in view else (part in WITH_BODY):
            continue
        if condition == PLAIN or (part in SLOW and name not in FINE):
            found += [(part, (name, view, condition, FRAMES, text, seed)) for seed in range(1, seeds + 1)]
    return found


def condition_of(row: dict) -> str:
    """The condition of a row's column."""
    return FINELY if row["recording"] in FINE else row["condition"]


def summary(rows: list[dict]) -> list[dict]:
    """Rows by part, condition and view: geometric means of error and time over those of the default on the same clouds."""
    default, found = {key_of(row): row for row in rows if row["part"] == "default"}, []
    for part, condition, view in dict.fromkeys((row["part"], condition_of(row), row["view"]) for row in rows):
        mine = [row for row in rows if (row["part"], condition_of(row), row["view"]) == (part, condition, view)]
        ratio = {field: [{field: row[field] / default[key_of(row)][field]} for row in mine] for field in FIELDS}
        by_recording = [
            geometric([each for each, row in zip(ratio["rmse_mm"], mine, strict=True) if row["recording"] == name], "rmse_mm")
            for name in dict.fromkeys(row["recording"] for row in mine)
        ]
        found.append(
            {
                "part": part,
                "condition": condition,
                "view": view,
                "recordings": len(by_recording),
                "runs": len(mine),
                "rmse_mm": round(geometric(mine, "rmse_mm"), 2),
                "error": round(geometric(ratio["rmse_mm"], "rmse_mm"), 3),
                "worse_without": sum(each > 1.0 for each in by_recording),
                "time": round(geometric(ratio["cpu_ms"], "cpu_ms"), 3),
            }
        )
    return found


def table(report: dict) -> None:
    """Prints the table in Markdown."""
    rows = {(row["part"], row["condition"], row["view"]): row for row in report["rows"]}
    columns = [(condition, view) for condition in (PLAIN, FINELY, SLOWLY) for view in VIEWS]
    names = {"full": "all around", "front": "one camera", "front+body": "one camera, body"}
    added = {PLAIN: "", FINELY: ", fine", SLOWLY: ", 10 per second"}
    heads = [names[view] + added[condition] for condition, view in columns]
    print(f"| without | {' | '.join(heads)} | time | lines |\n|---{'|---' * len(heads)}|---|---|")
    for part in dict.fromkeys(row["part"] for row in report["rows"]):
        cells = [rows.get((part, *column)) for column in columns]
        if part == "default":
            shown = [f"{cell['rmse_mm']:.1f} mm" if cell else "" for cell in cells]
        else:
            shown = [f"{cell['error']:.2f} ({cell['worse_without']}/{cell['recordings']})" if cell else "" for cell in cells]
        time = np.exp(np.mean([np.log(cell["time"]) for cell in cells[: len(VIEWS)] if cell]))
        print(f"| {part.removeprefix('no-')} | {' | '.join(shown)} | {time:.2f} | {report['lines'].get(part) or ''} |")


def main(argv: list[str] | None = None) -> int:
    """Runs and prints; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recordings", nargs="+", metavar="NAME", help=f"default: every {EVERY}nd of the training split")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--procs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=ROWS, help="file of the rows, which resumes")
    parser.add_argument("--json", type=Path, default=RESULT, help="file of the summary")
    parser.add_argument("--table", action="store_true", help="print the table of the summary, and run nothing")
    arguments = parsed(parser, argv, target="json")
    if arguments.table:
        table(json.loads(arguments.json.read_text()))
        return 0
    names = arguments.recordings or [each.name for each in collection.listed(collection.TRAINING)][::EVERY]
    names += [] if arguments.recordings else [name for name in FINE if name in recording_names()]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in arguments.out.read_text().splitlines()] if arguments.out.is_file() else []
    commit = machine.commit()
    rows = [row for row in rows if row.get("commit") == commit and row["frames"] == FRAMES]
    have = {job_key(row) for row in rows}
    todo = [job for job in jobs(names, arguments.seeds) if (job[0], *job[1][:3], job[1][5]) not in have]
    with multiprocessing.get_context("spawn").Pool(arguments.procs) as pool, arguments.out.open("a") as file:
        console, runs = Console(stderr=True), pool.imap(tracked, todo, chunksize=arguments.seeds)
        for row in track(runs, "tracking", len(todo), console=console):
            row["commit"] = commit
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    report = {"commit": commit, "machine": machine.describe()}
    report |= {"rows": summary(rows), "lines": {part: count for part in configurations() if (count := lines(part))}}
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    table(report)
    return 0


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

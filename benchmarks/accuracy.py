"""Accuracy on recordings: ``python benchmarks/accuracy.py [--sequences ...] [--views full front+body] [--variants ...]``.

Runs a grid of trials and writes one JSON row each into a file, from which a later call resumes; ``--table`` prints the tables of
a file. Recordings come from DDAKF_DATA and the bundled sample.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from committed import parsed
from rich.console import Console

from ddakf.evaluation import machine
from ddakf.evaluation.drawing import diagrams
from ddakf.evaluation.sensors.degradations import DISTURBANCES
from ddakf.evaluation.studies.execution import execute
from ddakf.evaluation.studies.row_log import RowLog
from ddakf.evaluation.trials import accuracy_tables, calibration_pools
from ddakf.evaluation.trials.methods import BASELINES
from ddakf.evaluation.trials.recordings import find_recording, recording_names
from ddakf.evaluation.trials.runs import START_FRAMES
from ddakf.evaluation.trials.trial import Trial
from ddakf.evaluation.trials.variants import ablations, refinements

ROOT = Path(__file__).resolve().parents[1]
OUT, RESULT = ROOT / "out/accuracy.jsonl", ROOT / "benchmarks/results/accuracy.json"
VARIANTS = ("default", *BASELINES, "paper", *ablations(), *refinements())


def main(argv: list[str] | None = None) -> int:
    """Runs the missing trials; returns the exit status."""
    arguments = parsed(_parser(), argv, target="summary")
    if arguments.table:
        print(accuracy_tables.report(read(arguments.out)))
        return 0
    if arguments.summary:
        arguments.summary.write_text(lines(accuracy_tables.summary(read(arguments.out)) | {"machine": machine.describe()}))
        return 0
    if arguments.figure:
        diagrams.reliability_diagram(arguments.figure, calibration_pools.reliability_curves(read(arguments.out)))
        return 0
    wanted = starts(arguments) if arguments.starts else grid(arguments)
    execute(wanted, RowLog(arguments.out), arguments.procs, Console(stderr=True), arguments.again)
    return 0


def grid(arguments) -> list[Trial]:
    """Sequence x view x seed x variant, without trials of the same result."""
    wanted = []
    for name, view, seed in itertools.product(arguments.sequences or recording_names(), arguments.views, arguments.seeds):
        view, _, body = view.partition("+")
        if (body or arguments.unsegmented) and not find_recording(name).has_body:
            continue
        for variant in arguments.variants:
            if not body and variant == "no-carrying":
                continue  # nothing carries the garment without a body
            trial = _trial(arguments, name, view, bool(body), seed, variant)
            wanted += [replace(trial, disturbance=script.name) for script in DISTURBANCES] if arguments.disturbances else [trial]
    return wanted


def starts(arguments) -> list[Trial]:
    """Random starts in random frames, alternating between the sequences; only the first view and the first seed are used."""
    chosen, wanted = arguments.sequences or recording_names(), []
    view, _, body = arguments.views[0].partition("+")
    for number in range(arguments.starts):
        name = chosen[number % len(chosen)]
        last = len(find_recording(name)) - 1 - START_FRAMES
        first = 0 if arguments.first_frame else int(np.random.default_rng([number, 1]).integers(last + 1))
        told = bool(body) and find_recording(name).has_body
        for variant in arguments.variants:
            trial = _trial(arguments, name, view, told, arguments.seeds[0], variant)
            wanted.append(replace(trial, start=number, first=first, frames=START_FRAMES))
    return wanted


def read(path: Path) -> list[dict]:
    """The rows of a file; none without a file."""
    return RowLog(path).rows()


def lines(report: dict) -> str:
    """JSON with a line per entry of a list, for reading and for diffs of versions."""
    parts = []
    for name, value in report.items():
        text = "[\n  " + ",\n  ".join(map(json.dumps, value)) + "\n ]" if isinstance(value, list) else json.dumps(value)
        parts.append(f" {json.dumps(name)}: {text}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _trial(arguments, name: str, view: str, body: bool, seed: int, variant: str) -> Trial:
    return Trial(
        name,
        view,
        body,
        seed,
        variant,
        arguments.frames,
        segmented=not arguments.unsegmented,
        points=arguments.points,
        noise=arguments.noise_mm / 1e3,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", nargs="+", metavar="NAME", help="default: the sample and all recordings of DDAKF_DATA")
    parser.add_argument("--views", nargs="+", default=["full"], metavar="VIEW", help="full, ring4, front, each also with +body")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], metavar="SEED", help="of the noise (default 1)")
    parser.add_argument("--variants", nargs="+", default=["default", "nicp"], metavar="VARIANT",
                        help=f"{', '.join(VARIANTS)}, or NAME={{JSON of Config.from_dict}}")  # fmt: skip
    parser.add_argument("--frames", type=int, help="tracked per trial (default all)")
    parser.add_argument("--points", type=int, default=10_000)
    parser.add_argument("--noise-mm", type=float, default=3.0)
    parser.add_argument("--unsegmented", action="store_true", help="points of the whole person")
    parser.add_argument("--disturbances", action="store_true", help="every trial of the grid through each of the disturbances")
    parser.add_argument("--starts", type=int, metavar="N", help="N random starts off the truth instead of the grid")
    parser.add_argument("--first-frame", action="store_true", help="start them in frame 0 instead of random frames")
    parser.add_argument("--procs", type=int, default=1, help="processes")
    parser.add_argument("--again", nargs="+", default=[], metavar="VARIANT",
                        help="run these, or all, again if their rows are of another commit")  # fmt: skip
    parser.add_argument("--out", type=Path, default=OUT, help=f"file of the rows (default {OUT.relative_to(ROOT)})")
    ending = parser.add_mutually_exclusive_group()
    ending.add_argument("--table", action="store_true", help="print the tables of --out, and run nothing")
    ending.add_argument("--summary", type=Path, nargs="?", const=RESULT, metavar="JSON",
                        help=f"write the means of --out (default {RESULT.relative_to(ROOT)}), and run nothing")  # fmt: skip
    ending.add_argument("--figure", type=Path, metavar="PNG", help="draw the reliability diagram of --out, and run nothing")
    return parser


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

"""Calibration: ``python benchmarks/calibration.py [--views front full+body ...] [--seeds ...] [--json FILE]``.

Runs the default on the sample, the recordings that ship for learning and those of DDAKF_DATA, prints coverage, NEES and
log-likelihoods by group, view and recording, and draws the reliability diagram. ``benchmarks/error_size.py`` fits the laws behind
the claimed covariances.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import accuracy
from rich.console import Console

from ddakf import data
from ddakf.evaluation import machine
from ddakf.evaluation.drawing import diagrams
from ddakf.evaluation.studies.execution import execute
from ddakf.evaluation.studies.row_log import RowLog
from ddakf.evaluation.trials import accuracy_tables, calibration_pools
from ddakf.evaluation.trials.recordings import find_recording, recording_names
from ddakf.evaluation.trials.trial import Trial

ROOT = Path(__file__).resolve().parents[1]
OUT, DIAGRAM = ROOT / "out/calibration.jsonl", ROOT / "out/calibration.png"
VIEWS = ("full", "full+body", "ring4", "front", "front+body")


def main(argv: list[str] | None = None) -> int:
    """Measures, and fits with ``--fit``; returns the exit status."""
    arguments = _parser().parse_args(argv)
    if arguments.json:
        machine.require_committed(arguments.json, arguments.allow_dirty)
    shipped = (path.stem for path in data.TRAINING.glob("*.npz"))
    wanted = grid(arguments, sorted(arguments.sequences or {*recording_names(), *shipped}))
    journal = RowLog(arguments.out)
    execute(wanted, journal, arguments.procs, Console(stderr=True))
    rows = journal.rows(wanted)
    print(accuracy_tables.calibration(rows))
    diagrams.reliability_diagram(arguments.diagram, calibration_pools.reliability_curves(rows))
    if arguments.json:
        arguments.json.write_text(accuracy.lines(report(rows)))
    return 0


def grid(arguments, names: list[str]) -> list[Trial]:
    """Sequence x view x seed; views with the body only for sequences that have one."""
    views = [view.partition("+") for view in arguments.views]
    return [
        Trial(name, view, bool(body), seed, "default", arguments.frames)
        for name in names
        for view, _, body in views
        if not body or find_recording(name).has_body
        for seed in arguments.seeds
    ]


def report(rows: list[dict]) -> dict:
    """The content of the JSON file."""
    parts = [
        {key: float(f"{value:.4g}") if isinstance(value, float) else value for key, value in part.items()}
        for part in calibration_pools.calibrated(rows)
    ]
    return {"machine": machine.describe(), "commits": sorted({str(row.get("commit")) for row in rows}), "calibration": parts}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", nargs="+", metavar="NAME", help="default: all that ship, and those of DDAKF_DATA")
    parser.add_argument("--views", nargs="+", default=list(VIEWS), metavar="VIEW", help=f"default: {' '.join(VIEWS)}")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], metavar="SEED", help="of the noise (default 1)")
    parser.add_argument("--frames", type=int, help="tracked per trial (default all)")
    parser.add_argument("--procs", type=int, default=2, help="processes (default 2)")
    what = "write into the checkout's results although its code has uncommitted changes"
    parser.add_argument("--allow-dirty", action="store_true", help=what)
    parser.add_argument("--out", type=Path, default=OUT, help=f"file of the rows (default {OUT.relative_to(ROOT)})")
    parser.add_argument("--diagram", type=Path, default=DIAGRAM, metavar="PNG",
                        help=f"picture (default {DIAGRAM.relative_to(ROOT)})")  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="of the table")
    return parser


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

"""Calibration: ``python benchmarks/calibration.py [--fit] [--views front full+body ...] [--seeds ...]``.

Runs the default on all recordings, prints coverage, NEES and log-likelihoods by group, and draws the reliability diagram. The
table has the half of the recordings on which the two constants are fitted, the other half, each view and each recording. With
``--fit`` all trials run anew, and the constants ``Uncertainty.observed_scale`` and ``unseen_scale`` are fitted on the first half,
such that the 90 % ellipsoids hold 90 % in the mean over recordings. Table and diagram then use them, and go into
``benchmarks/results`` and ``docs``. The constants scale the claimed covariances and hardly change the estimate, so that one run
of every trial is enough. Recordings are those that ship and those of DDAKF_DATA.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import accuracy
import numpy as np
import numpy.typing as npt
from rich.console import Console
from scipy.stats import chi2

from ddakf import data
from ddakf.config import Uncertainty
from ddakf.evaluation import machine
from ddakf.evaluation.drawing import diagrams
from ddakf.evaluation.metrics.calibration import NOMINAL_PROBABILITIES
from ddakf.evaluation.studies.execution import execute
from ddakf.evaluation.studies.row_log import RowLog
from ddakf.evaluation.trials import accuracy_tables, calibration_pools
from ddakf.evaluation.trials.recordings import find_recording, recording_names
from ddakf.evaluation.trials.trial import Trial

ROOT = Path(__file__).resolve().parents[1]
OUT, DIAGRAM = ROOT / "out/calibration.jsonl", ROOT / "out/calibration.png"
RESULT, PICTURE = ROOT / "benchmarks/results/calibration.json", ROOT / "docs/calibration.png"
VIEWS = ("full", "full+body", "ring4", "front", "front+body")
WANTED = 0.9  # share of the vertices in the ellipsoid of that probability
OBSERVED, *HIDDEN = calibration_pools.GROUPS


def main(argv: list[str] | None = None) -> int:
    """Measures, and fits with ``--fit``; returns the exit status."""
    arguments = _parser().parse_args(argv)
    if arguments.fit:
        arguments.out.unlink(missing_ok=True)  # rows of another tracker
    shipped = (path.stem for path in data.TRAINING.glob("*.npz"))
    wanted = grid(arguments, sorted(arguments.sequences or {*recording_names(), *shipped}))
    journal = RowLog(arguments.out)
    execute(wanted, journal, arguments.procs, Console(stderr=True))
    rows = journal.rows(wanted)
    factors = fitted(rows) if arguments.fit else {}
    constants = {
        "observed_scale": Uncertainty.observed_scale * factors.get(OBSERVED, 1.0),
        "unseen_scale": Uncertainty.unseen_scale * factors.get(HIDDEN[0], 1.0),
    }
    print(accuracy_tables.calibration(rows, scale=factors))
    print(", ".join(f"{name} {value:.3f}" for name, value in constants.items()))
    curves = calibration_pools.reliability_curves(rows, scale=factors)
    diagrams.reliability_diagram(arguments.diagram or (PICTURE if arguments.fit else DIAGRAM), curves)
    if arguments.fit:
        arguments.json.write_text(accuracy.lines(report(rows, factors, constants)))
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


def fitted(rows: list[dict]) -> dict[str, float]:
    """Factor on the standard deviations of each group, from the first half of the recordings, each of which counts once: long
    recordings of many vertices are no likelier to be like the next one.

    Hidden vertices have one factor, which suits those on a body that is given: without it they may be claimed to be less certain
    than they are, but never more.
    """
    half, _ = calibration_pools.half_of(rows)
    inside = defaultdict(list)
    for name in half:
        own = [row for row in rows if row["sequence"] == name and "failed" not in row]
        for group, pool in calibration_pools.pooled(own).items():
            inside[group].append(pool["inside"])
    factor = {group: ellipsoid_scale(np.mean(shares, axis=0)) for group, shares in inside.items()}
    hidden = next(factor[group] for group in HIDDEN if group in factor)
    return {OBSERVED: factor[OBSERVED]} | dict.fromkeys(HIDDEN, hidden)


def ellipsoid_scale(inside: npt.ArrayLike) -> float:
    """Factor on the standard deviations with which the ellipsoids of probability WANTED would hold as much.

    Args:
        inside: shares of the vertices in the ellipsoids of the probabilities NOMINAL_PROBABILITIES.
    """
    probability = np.interp(WANTED, inside, NOMINAL_PROBABILITIES)
    return float(np.sqrt(chi2.ppf(probability, 3) / chi2.ppf(WANTED, 3)))


def report(rows: list[dict], factors: dict[str, float], constants: dict[str, float]) -> dict:
    """The content of the file in ``benchmarks/results``."""
    half, other = calibration_pools.half_of(rows)
    parts = [
        {key: float(f"{value:.4g}") if isinstance(value, float) else value for key, value in part.items()}
        for part in calibration_pools.calibrated(rows, scale=factors)
    ]
    return {
        "machine": machine.describe(),
        "commits": sorted({str(row.get("commit")) for row in rows}),
        "constants": {name: round(value, 3) for name, value in constants.items()},
        "fitted_on": half,
        "held_out": other,
        "calibration": parts,
    }


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fit", action="store_true", help="run all trials anew, fit the constants, and save the result")
    parser.add_argument("--sequences", nargs="+", metavar="NAME", help="default: all that ship, and those of DDAKF_DATA")
    parser.add_argument("--views", nargs="+", default=list(VIEWS), metavar="VIEW", help=f"default: {' '.join(VIEWS)}")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], metavar="SEED", help="of the noise (default 1)")
    parser.add_argument("--frames", type=int, help="tracked per trial (default all)")
    parser.add_argument("--procs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--out", type=Path, default=OUT, help=f"file of the rows (default {OUT.relative_to(ROOT)})")
    parser.add_argument("--diagram", type=Path, metavar="PNG", help=f"picture (default {DIAGRAM.relative_to(ROOT)}; with --fit "
                        f"{PICTURE.relative_to(ROOT)})")  # fmt: skip
    parser.add_argument("--json", type=Path, default=RESULT, help=f"of --fit (default {RESULT.relative_to(ROOT)})")
    return parser


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

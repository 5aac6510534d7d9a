"""Calibration: ``python benchmarks/calibration.py [--fit] [--views front full+body ...] [--seeds ...]``.

With ``--fit``, finds the two constants of the covariance, ``Uncertainty.missed_share`` and ``unseen_share``, on every second
recording, such that the 90 % ellipsoids hold 90 %. Without it, runs the default on all recordings, prints coverage, NEES and
log-likelihoods by group, for the half that the constants are fitted on, for the other half and by recording, and draws the
reliability diagram. Recordings are found through DDAKF_DATA.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import accuracy
import numpy as np
from scipy.stats import chi2

from ddakf.config import Uncertainty
from ddakf.evaluation import figures, tables, trials
from ddakf.evaluation.trials import NOMINAL, Trial

ROOT = Path(__file__).resolve().parents[1]
OUT, DIAGRAM = ROOT / "out/calibration.jsonl", ROOT / "out/calibration.png"
VIEWS = ("full", "full+body", "ring4", "front", "front+body")
WANTED = 0.9  # share of the vertices in the ellipsoid of that probability
ROUNDS = 4  # of the fit; the scale of an ellipsoid follows a constant almost in proportion


def main(argv: list[str] | None = None) -> int:
    """Fits or measures; returns the exit status."""
    arguments = _parser().parse_args(argv)
    if arguments.fit:
        fit(arguments)
        return 0
    wanted = grid(arguments, sorted(arguments.sequences or trials.names()), "default")
    done = {Trial.of(row) for row in accuracy.read(arguments.out)}
    accuracy.execute([trial for trial in wanted if trial not in done], arguments.out, arguments.procs)
    rows = [row for row in accuracy.read(arguments.out) if Trial.of(row) in set(wanted)]
    print(tables.calibration(rows))
    figures.reliability_diagram(arguments.diagram, tables.reliability_curves(rows))
    return 0


def grid(arguments, names: list[str], variant: str) -> list[Trial]:
    """Sequence x view x seed; the body only where there is one."""
    views = [view.partition("+") for view in arguments.views]
    return [
        Trial(name, view, bool(body), seed, variant, arguments.frames)
        for name in names
        for view, _, body in views
        if not body or trials.recording(name).has_body
        for seed in arguments.seeds
    ]


def fit(arguments) -> None:
    """Prints the constants of each round, and how far the ellipsoids of each group were off in it."""
    names = sorted(arguments.sequences or trials.names())[::2]  # the first half of tables.calibration
    missed, unseen = Uncertainty.missed_share, Uncertainty.unseen_share
    accuracy.prepare()
    print(f"fitted on {', '.join(names)}")
    for number in range(ROUNDS):
        values = {"uncertainty": {"missed_share": missed, "unseen_share": unseen}}
        rows = [trials.run(trial) for trial in grid(arguments, names, f"fit={json.dumps(values)}")]
        pools = tables.pooled(row for row in rows if "failed" not in row)
        factor = {group: ellipsoid_scale(pool["inside"]) for group, pool in pools.items()}
        off = ", ".join(f"{group} {pools[group]['coverage90']:.3f} (x {factor[group]:.2f})" for group in pools)
        print(f"round {number}: missed_share {missed:.3f}, unseen_share {unseen:.3f}: {off}", flush=True)
        told = [factor[group] for group in tables.GROUPS[:2] if group in factor]
        missed *= float(np.exp(np.mean(np.log(told))))
        unseen *= factor.get(tables.GROUPS[2], 1.0)
    print(f"missed_share {missed:.3f}, unseen_share {unseen:.3f}")


def ellipsoid_scale(inside: list[float]) -> float:
    """Factor on the standard deviations with which the ellipsoids of probability WANTED would hold as much.

    Args:
        inside: shares of the vertices in the ellipsoids of the probabilities NOMINAL.
    """
    probability = np.interp(WANTED, inside, NOMINAL)
    return float(np.sqrt(chi2.ppf(probability, 3) / chi2.ppf(WANTED, 3)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fit", action="store_true", help="find the constants instead of showing what they are worth")
    parser.add_argument("--sequences", nargs="+", metavar="NAME", help="default: the sample and all recordings of DDAKF_DATA")
    parser.add_argument("--views", nargs="+", default=list(VIEWS), metavar="VIEW", help=f"default: {' '.join(VIEWS)}")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], metavar="SEED", help="of the noise (default 1)")
    parser.add_argument("--frames", type=int, help="tracked per trial (default all)")
    parser.add_argument("--procs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, default=OUT, help=f"file of the rows (default {OUT.relative_to(ROOT)})")
    parser.add_argument("--diagram", type=Path, default=DIAGRAM, help=f"picture (default {DIAGRAM.relative_to(ROOT)})")
    return parser


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

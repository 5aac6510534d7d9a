"""Error of results predicted to the time of display: ``python benchmarks/latency.py [--frames 60] [--write]``.

Each result of the tracker is compared with the truth some milliseconds after its frame, unchanged and moved on by
``Tracker.predicted``. The truth between two frames is interpolated linearly. Recordings come from DDAKF_DATA and the bundled
sample.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import inputs
import numpy as np
from committed import parsed
from threadpoolctl import threadpool_limits

import ddakf
from ddakf.commands import warmup
from ddakf.evaluation import machine, metrics

ROOT = Path(__file__).resolve().parents[1]
RESULT, DOCUMENT = ROOT / "benchmarks/results/latency.json", ROOT / "docs/protocol.md"
DELAYS = (0.03, 0.06, 0.09, 0.12)  # s from the capture of a frame to its display
POINTS = 5_000
FIRST = 5  # frames at the start that are excluded: velocities are not known yet
CHI2_90 = 6.2514  # of three degrees of freedom


def main(argv: list[str] | None = None) -> int:
    """Measures, prints and writes; returns the exit status."""
    arguments = parsed(_parser(), argv)
    if arguments.write:
        DOCUMENT.write_text(fresh(json.loads(arguments.out.read_text())))
        return 0
    threadpool_limits(1)
    warmup.warm()
    rows = []
    for sequence in inputs.sequences():
        views = ("full", "front+body") if sequence.has_body else ("full", "front")
        for view in views:
            name, _, body = view.partition("+")
            rows.append(measured(inputs.run_of(sequence, arguments.frames, name, POINTS, body=bool(body))))
            print(line(rows[-1]), flush=True)
    report = {"machine": machine.describe(), "commit": machine.commit(), "frames": arguments.frames, "rows": rows}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(report, indent=1) + "\n")
    return 0


def measured(run: inputs.Run) -> dict:
    """One run: of every delay the mean RMSE of the predicted and of the plain result, and their share inside the ellipsoids."""
    tracker, sums = run.tracker(), {delay: [] for delay in DELAYS}
    for number, cloud, how in run.frames():
        result = tracker.step(cloud.points, **how)
        for delay in DELAYS:
            truth = between(run, number + delay * run.sequence.fps)
            if truth is None or number < FIRST:
                continue
            later = tracker.predicted(result, delay)
            sums[delay].append([*quality(later, truth), *quality(result, truth)])
    keys = "predicted_rmse_mm", "predicted_coverage90", "plain_rmse_mm", "plain_coverage90"
    means = {delay: np.mean(rows, axis=0).round(3).tolist() for delay, rows in sums.items() if rows}
    return {
        "name": run.name,
        "delays": [
            {"ms": round(1e3 * delay), "frames": len(sums[delay])} | dict(zip(keys, means[delay], strict=True)) for delay in means
        ],
    }


def between(run: inputs.Run, place: float) -> np.ndarray | None:
    """(V, 3) truth at a place between two frames, metres; None after the last."""
    truth, before = run.sequence.garment_vertices, int(np.floor(place + 1e-9))
    if before + 1 >= len(truth):
        return None
    share = max(0.0, place - before)
    return (1 - share) * truth[before] + share * truth[before + 1]


def quality(result: ddakf.FrameResult, truth: np.ndarray) -> tuple[float, float]:
    """RMSE in mm, and the share of the vertices whose 90 % ellipsoid holds the truth."""
    error = result.vertices - truth
    squared = np.einsum("va,va->v", error, np.linalg.solve(result.covariance, error[:, :, None])[:, :, 0])
    return metrics.rmse_mm(result.vertices, truth), float(np.mean(squared < CHI2_90))


def line(row: dict) -> str:
    """A run as a row of a table."""
    cells = (
        f"{at['predicted_rmse_mm']:.1f} ({at['plain_rmse_mm']:.1f}), {at['predicted_coverage90']:.0%}" for at in row["delays"]
    )
    return f"| {row['name']} | {' | '.join(cells)} |"


def fresh(report: dict) -> str:
    """The document with the report's table."""
    begin, end = "<!-- latency: begin -->", "<!-- latency: end -->"
    heads = [f"{at['ms']} ms" for at in report["rows"][0]["delays"]]
    lines = [f"| predicted (as captured), inside | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
    lines += map(line, report["rows"])
    head, _, rest = DOCUMENT.read_text().partition(begin)
    return "\n".join([head + begin, *lines, end]) + rest.partition(end)[2]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60, help="of each recording (default 60)")
    parser.add_argument("--out", type=Path, default=RESULT, help="result file")
    parser.add_argument("--write", action="store_true", help="write the table of docs/protocol.md from the result file")
    return parser


if __name__ == "__main__":
    sys.exit(main())

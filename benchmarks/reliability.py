"""How well the reliability score ranks the error, on the fixed list of degraded runs (ddakf.evaluation.degradations).

    python benchmarks/reliability.py [--procs 2] [--json benchmarks/results/reliability.json]
    python benchmarks/reliability.py --fit        # the weights of the evidence, fitted on one half of the sequences

The half that the weights are fitted on and the other half are reported apart. Without DDAKF_DATA there is the bundled
sample alone.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from contextlib import contextmanager
from pathlib import Path

import machine
import numpy as np
from inputs import sequences
from scipy.optimize import minimize

import ddakf
from ddakf import reliability
from ddakf.evaluation import metrics
from ddakf.evaluation.degradations import CLEAN, FRAMES, DegradedRun, degraded_runs
from ddakf.evaluation.sensors import Sensor
from ddakf.evaluation.source import SequenceSource

FITTED_ON = ("pergamo_005", "sim_tank_move", "samba_dress")
NORMAL_FACTOR = 2.0  # times the clean run's median error: above it a frame counts as bad
USABLE = 0.05  # m: of a track with a larger error it is right to be alarmed, however usual the error is
SMALLEST_SHARE = 1e-3  # of the mean prediction: a contribution with less is dropped
WORST = 0.3  # m: an error beyond it is lost, and how far beyond says nothing


# Runs ---------------------------------------------------------------------------------------------------------------


@contextmanager
def watched(verdicts: list):
    """Stage G keeps every verdict in the list."""
    judge = reliability.judge

    def keeping(*arguments):
        verdicts.append(judge(*arguments))
        return verdicts[-1]

    reliability.judge = keeping
    try:
        yield
    finally:
        reliability.judge = judge


def played(run: DegradedRun, source: SequenceSource, frames: list) -> list[dict]:
    """Every frame that arrived: its errors and what the tracker said of it."""
    tracker = ddakf.Tracker(source.garment, body=source.body)
    tracker.reset(source.start)
    sequence, rows, verdicts = source.sequence, [], []
    inside = metrics.Penetration(ddakf.Mesh(sequence.body_vertices[0], sequence.body_faces)) if sequence.has_body else None
    with watched(verdicts):
        for frame, degraded in run.script.apply(frames, run.seed):
            result = tracker.step(
                frame.points,
                timestamp=frame.timestamp,
                sensor_origin=frame.sensor_origin,
                body_vertices=frame.body_vertices,
            )
            error = np.linalg.norm(result.vertices - frame.truth, axis=1)
            rows.append({
                "number": frame.number, "degraded": degraded, "state": result.state,
                "rmse": metrics.rmse_mm(result.vertices, frame.truth) / 1e3,
                "penetration": None if inside is None else inside(result.vertices, frame.body)[0],
                "score": result.reliability, "paper": result.paper_score,
                "vertex": metrics.spearman(result.vertex_reliability, error),
                "evidence": list(verdicts[-1].evidence),
            })  # fmt: skip
    return rows


def group(job: tuple[str, str]) -> list[dict]:
    """All scripts, and none, on one view of one sequence."""
    name, view = job
    sequence = next(s for s in sequences() if s.name == name)
    source = SequenceSource(
        sequence, Sensor(view), range(min(FRAMES + 1, len(sequence))), give_body=sequence.has_body and view == "front"
    )
    frames = list(source)
    runs = [run for run in degraded_runs([(name, sequence.has_body)]) if run.view == view]
    runs.insert(0, replace_script(runs[0]))
    out = []
    for run in runs:
        rows = played(run, source, frames)
        out.append({"sequence": name, "view": view, "body": run.give_body, "script": run.script.name, "frames": rows})
        error = 1e3 * np.array([row["rmse"] for row in rows])
        ranked = metrics.spearman(np.array([row["score"] for row in rows]), error)
        print(f"{name} {view} {run.script.name}: RMSE {error.mean():.1f} mm, Spearman {ranked:.2f}", file=sys.stderr, flush=True)
    return out


def replace_script(run: DegradedRun) -> DegradedRun:
    """The same run undegraded."""
    return run._replace(script=CLEAN)


# Figures ------------------------------------------------------------------------------------------------------------


def column(run: dict, name: str) -> np.ndarray:
    return np.array([row[name] for row in run["frames"]], float)


def bad(run: dict, clean: dict) -> np.ndarray:
    """Whether each frame's error is above twice the clean run's median."""
    return column(run, "rmse") > NORMAL_FACTOR * np.median(column(clean, "rmse"))


def figures(runs: list[dict], score: str = "score") -> dict:
    """What is asked of a score, over degraded runs and the clean ones of the same views."""
    clean = {(run["sequence"], run["view"]): run for run in runs if run["script"] == CLEAN.name}
    degraded = [run for run in runs if run["script"] != CLEAN.name]

    def pooled(what, some):
        return metrics.spearman(*(np.concatenate([column(run, c) for run in some]) for c in (score, what)))

    def within(what, some):
        return float(np.median([metrics.spearman(column(run, score), column(run, what)) for run in some]))

    with_body = [run for run in degraded if run["frames"][0]["penetration"] is not None]
    labels = [bad(run, clean[run["sequence"], run["view"]]) for run in degraded]
    areas = [metrics.roc_auc(-column(run, score), label) for run, label in zip(degraded, labels, strict=True)]
    quiet = np.concatenate([~bad(run, run) for run in clean.values()])
    usable = np.concatenate([column(run, "rmse") < USABLE for run in clean.values()])
    alarm = np.concatenate([[row["state"] in ("recovering", "lost") for row in run["frames"]] for run in clean.values()])
    return {
        "runs": len(degraded), "frames": int(sum(len(run["frames"]) for run in degraded)),
        "degraded": float(np.mean(np.concatenate([column(run, "degraded") for run in degraded]))),
        "error, pooled": pooled("rmse", degraded), "error, within": within("rmse", degraded),
        "error, within clean": within("rmse", list(clean.values())),
        "penetration, pooled": pooled("penetration", with_body) if with_body else None,
        "penetration, within": within("penetration", with_body) if with_body else None,
        "ROC area, pooled": metrics.roc_auc(
            -np.concatenate([column(run, score) for run in degraded]), np.concatenate(labels)
        ),
        "ROC area, within": float(np.nanmedian(areas)),
        "false alarms": float((alarm & quiet).sum() / max(quiet.sum(), 1)),
        "false alarms below 5 cm": float((alarm & quiet & usable).sum() / max((quiet & usable).sum(), 1)),
        "vertex, within a frame": float(np.nanmedian(np.concatenate([column(run, "vertex") for run in runs]))),
    }  # fmt: skip


def rescored(runs: list[dict], weights: np.ndarray) -> list[dict]:
    """The runs with the score of other weights; the states stay what they were."""
    half = ddakf.Config().reliability.half_error
    out = []
    for run in runs:
        e2 = np.array([row["evidence"] for row in run["frames"]]) @ weights
        scores = 1.0 / (1.0 + e2 / half**2)
        out.append(run | {"frames": [row | {"score": s} for row, s in zip(run["frames"], scores, strict=True)]})
    return out


def fitted(runs: list[dict]) -> np.ndarray:
    """Weights, none negative, that predict log(error^2); deviations within a run count fully, a run's own level by a third."""
    X = [np.array([row["evidence"] for row in run["frames"]]) for run in runs]
    scale = np.concatenate(X).mean(axis=0) + 1e-15
    X = [x / scale for x in X]
    Y = [np.log(np.minimum(column(run, "rmse"), WORST) ** 2) for run in runs]

    def loss(q):
        weight, total, slope = np.exp(q), 0.0, np.zeros_like(q)
        for x, y in zip(X, Y, strict=True):
            p = x @ weight + 1e-9
            d = np.log(p) - y
            inner = d - d.mean()
            total += (inner @ inner + d @ d / 3) / len(d)
            slope += (2 * (inner + d / 3) / p / len(d)) @ x * weight
        return total / len(X), slope / len(X)

    start = np.full(len(scale), np.log(1e-3 / len(scale)))
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=[(-30, 5)] * len(scale), options={"maxiter": 1000})
    weights = np.exp(found.x) / scale
    share = weights * scale
    return np.where(share > SMALLEST_SHARE * share.sum(), weights, 0.0)


def halves(runs: list[dict]) -> dict[str, list[dict]]:
    """All runs, those that the weights were fitted on, and the others; only what is not empty."""
    fit = [run for run in runs if run["sequence"] in FITTED_ON]
    rest = [run for run in runs if run["sequence"] not in FITTED_ON]
    return {name: part for name, part in (("all", runs), ("fitted on", fit), ("held back", rest)) if part}


def show(title: str, values: dict) -> None:
    print(f"{title}:")
    for name, value in values.items():
        print(f"  {name:24s} {value:.3f}" if isinstance(value, float) else f"  {name:24s} {value}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fit", action="store_true", help="fit the weights, print them and what they bring")
    parser.add_argument("--sequences", nargs="+", help="some of them")
    parser.add_argument("--views", nargs="+", default=["full", "front"])
    parser.add_argument("--procs", type=int, default=1)
    parser.add_argument("--frames", type=Path, help="file to keep every frame in, or to read them from where it exists")
    parser.add_argument("--json", type=Path, help="result file")
    arguments = parser.parse_args()
    if arguments.frames and arguments.frames.exists():
        runs = json.loads(arguments.frames.read_text())
    else:
        names = arguments.sequences or [s.name for s in sequences()]
        jobs = [(name, view) for name in names for view in arguments.views]
        with multiprocessing.get_context("spawn").Pool(arguments.procs) as pool:
            mapped = pool.imap if arguments.procs > 1 else map
            runs = [run for some in mapped(group, jobs) for run in some]
        if arguments.frames:
            arguments.frames.write_text(json.dumps(runs))
    report = {"commit": machine.commit(), "machine": machine.describe(), "fitted_on": FITTED_ON}
    for name, some in halves(runs).items():
        report[name] = {"product": figures(some), "paper": figures(some, "paper")}
        show(f"{name}, product's score", report[name]["product"])
        show(f"{name}, s_k", report[name]["paper"])
    if arguments.fit:
        weights = fitted([run for run in runs if run["sequence"] in FITTED_ON] or runs)
        for name, weight in zip(reliability.Evidence._fields, weights, strict=True):
            print(f"    {name}={weight:.4g},")
        for name, some in halves(rescored(runs, weights)).items():
            show(f"{name}, with the fitted weights", figures(some))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())

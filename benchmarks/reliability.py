"""Rank correlation of the reliability of frames and vertices with the error, on the fixed list of degraded runs
(ddakf.evaluation.sensors.degradations).

    python benchmarks/reliability.py [--procs 2] [--json benchmarks/results/reliability.json]

The law of the predicted error is fitted to other recordings: ``python benchmarks/error_size.py --fit``. Without DDAKF_DATA only
the bundled sample is used.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
from committed import parsed
from inputs import sequences
from scipy.stats import rankdata

import ddakf
from ddakf.evaluation import machine, metrics
from ddakf.evaluation.sensors import Sensor
from ddakf.evaluation.sensors.degradations import CLEAN, FRAMES, DegradedRun, degraded_runs
from ddakf.evaluation.tracking.sources import SequenceSource

WORSE = 2.0  # times the clean run's error of the same frame: above it a frame counts as bad
VERTICES = 100  # saved of a frame
SETTINGS = ddakf.Config().reliability


# Runs ---------------------------------------------------------------------------------------------------------------


def played(run: DegradedRun, source: SequenceSource, frames: list) -> dict[str, np.ndarray]:
    """Errors and the tracker's scores of every frame that arrived; T frames."""
    tracker = ddakf.Tracker(source.garment, body=source.body)
    tracker.reset(source.start)
    sequence, rows = source.sequence, []
    inside = metrics.Penetration(ddakf.Mesh(sequence.body_vertices[0], sequence.body_faces)) if sequence.has_body else None
    saved = np.random.default_rng(0).permutation(source.garment.n_vertices)[:VERTICES]
    for frame, degraded in run.script.apply(frames, run.seed):
        result = tracker.step(
            frame.points,
            timestamp=frame.timestamp,
            sensor_origin=frame.sensor_origin,
            body_vertices=frame.body_vertices,
        )
        rows.append({
            "number": frame.number, "degraded": degraded, "lost": result.state == "lost",
            "rmse": metrics.rmse_mm(result.vertices, frame.truth) / 1e3,
            "penetration": np.nan if inside is None else inside(result.vertices, frame.body)[0],
            "score": result.reliability, "paper": result.paper_score,
            "vertex_score": result.vertex_reliability[saved],
            "vertex_error": np.linalg.norm(result.vertices - frame.truth, axis=1)[saved],
        })  # fmt: skip
    return {name: np.array([row[name] for row in rows], np.float64) for name in rows[0]}


def group(job: tuple[str, str, bool]) -> list[dict]:
    """Runs of one view of one sequence: every script, and none."""
    name, view, give_body = job
    sequence = next(s for s in sequences() if s.name == name)
    source = SequenceSource(sequence, Sensor(view), range(min(FRAMES + 1, len(sequence))), give_body=give_body)
    frames, out = list(source), []
    runs = [run for run in degraded_runs([(name, sequence.has_body)]) if (run.view, run.give_body) == (view, give_body)]
    for run in (runs[0]._replace(script=CLEAN), *runs):
        out.append({"sequence": name, "view": view, "body": give_body, "script": run.script.name} | played(run, source, frames))
        error, ranked = 1e3 * out[-1]["rmse"], metrics.spearman(out[-1]["score"], out[-1]["rmse"])
        title = f"{name} {view_of(out[-1])} {run.script.name}"
        print(f"{title}: RMSE {error.mean():.1f} mm, Spearman {ranked:.2f}", file=sys.stderr, flush=True)
    return out


def all_runs(names: list[str] | None, views: list[str], procs: int, saved: Path | None) -> list[dict]:
    """All wanted runs; those in the file ``saved`` are not run again."""
    runs = load(saved) if saved and saved.exists() else []
    done = {place(run) for run in runs}
    chosen = [s for s in sequences() if names is None or s.name in names]
    size = {s.name: s.garment_vertices.shape[1] for s in chosen}
    jobs = dict.fromkeys((r.sequence, r.view, r.give_body) for r in degraded_runs([(s.name, s.has_body) for s in chosen]))
    jobs = sorted((job for job in jobs if job[1] in views and job not in done), key=lambda job: size[job[0]])
    with multiprocessing.get_context("spawn").Pool(procs) if procs > 1 and jobs else nullcontext() as pool:
        for more in pool.imap_unordered(group, jobs) if pool else map(group, jobs):
            runs += more
            if saved:
                save(saved, runs)
    return runs


def save(path: Path, runs: list[dict]) -> None:
    np.savez_compressed(path, **{f"{k}.{name}": value for k, run in enumerate(runs) for name, value in run.items()})


def load(path: Path) -> list[dict]:
    runs: dict[int, dict] = {}
    with np.load(path) as archive:
        for key in archive.files:
            k, name = key.split(".")
            value = archive[key]
            runs.setdefault(int(k), {})[name] = value.item() if value.ndim == 0 else value
    return list(runs.values())


# Figures ------------------------------------------------------------------------------------------------------------


def pooled(runs: list[dict], name: str) -> np.ndarray:
    return np.concatenate([run[name] for run in runs])


def place(run: dict) -> tuple:
    return run["sequence"], run["view"], run["body"]


def view_of(run: dict) -> str:
    return run["view"] + ("+body" if run["body"] else "")


def of_clean(run: dict, clean: dict[tuple, dict]) -> np.ndarray:
    """(T,) m: the clean run's error of the same frames."""
    reference = clean[place(run)]
    return reference["rmse"][np.searchsorted(reference["number"], run["number"])]


def alarms(run: dict, score: str) -> np.ndarray:
    """(T,) bool: lost, or below the threshold of recovery until above that at its end."""
    out, alarmed = np.zeros(len(run["rmse"]), bool), False
    for k, value in enumerate(run[score]):
        alarmed = value < (SETTINGS.recovery_above if alarmed else SETTINGS.recovery_below)
        out[k] = alarmed or run["lost"][k]
    return out


def share(chosen: np.ndarray, of: np.ndarray) -> float | None:
    return float((chosen & of).sum() / of.sum()) if of.any() else None


def ranking(runs: list[dict], score: str, error: str) -> dict[str, float] | None:
    """Rank correlation of a score with the error, which should be negative: of all frames, and the median over the runs."""
    if not runs:
        return None
    within = [metrics.spearman(run[score], run[error]) for run in runs]
    return {"pooled": metrics.spearman(pooled(runs, score), pooled(runs, error)), "within": float(np.nanmedian(within))}


def figures(runs: list[dict], score: str = "score") -> dict:
    """Figures of a score on the degraded runs, and on the clean ones where the name has it."""
    clean = {place(run): run for run in runs if run["script"] == CLEAN.name}
    degraded = [run for run in runs if run["script"] != CLEAN.name]
    bodies = [run for run in degraded if np.isfinite(run["penetration"]).all()]
    blind, told = [run for run in bodies if not run["body"]], [run for run in bodies if run["body"]]
    bad = [run["rmse"] > WORSE * of_clean(run, clean) for run in degraded]
    areas = [metrics.roc_auc(-run[score], label) for run, label in zip(degraded, bad, strict=True)]
    quiet = list(clean.values())
    alarm, error = np.concatenate([alarms(run, score) for run in quiet]), pooled(quiet, "rmse")
    typical = np.concatenate([run["rmse"] <= WORSE * np.median(run["rmse"]) for run in quiet])
    half, low = SETTINGS.half_error, SETTINGS.half_error * np.sqrt(1 / SETTINGS.recovery_below - 1)
    any_alarm, any_error = np.concatenate([alarms(run, score) for run in runs]), pooled(runs, "rmse")
    return {
        "runs": len(degraded), "frames": int(sum(len(run["rmse"]) for run in degraded)),
        "share of degraded frames": float(pooled(degraded, "degraded").mean()),
        "error": ranking(degraded, score, "rmse"),
        "error, clean runs": ranking(quiet, score, "rmse"),
        "penetration, no body given": ranking(blind, score, "penetration"),
        "of the error itself with it": ranking([run | {"minus": -run["rmse"]} for run in blind], "minus", "penetration"),
        "penetration, body given": ranking(told, score, "penetration"),
        "ROC area": {
            "pooled": metrics.roc_auc(-pooled(degraded, score), np.concatenate(bad)), "within": float(np.nanmedian(areas)),
            "mean": float(np.nanmean(areas)),
        },
        "false alarms, clean runs": {
            f"error below {1e3 * half:.0f} mm": share(alarm, error < half),
            f"error below {WORSE:g} times the run's median": share(alarm, typical),
        },
        "alarms, all runs": {
            f"error below {1e3 * half:.0f} mm": share(any_alarm, any_error < half),
            f"error above {1e3 * low:.0f} mm": share(any_alarm, any_error > low),
        },
    }  # fmt: skip


def vertex_figures(runs: list[dict]) -> dict:
    """Rank correlation with the error of the vertices within each frame; and the error at each value."""
    ranked, views = [], []
    for run in runs:
        a, b = (rankdata(values, axis=1) for values in (-run["vertex_score"], run["vertex_error"]))
        a, b = (ranks - ranks.mean(axis=1, keepdims=True) for ranks in (a, b))
        ranked.append((a * b).sum(axis=1) / np.sqrt(np.maximum((a**2).sum(axis=1) * (b**2).sum(axis=1), 1e-12)))
        views.append(view_of(run))
    correlation = {view: [] for view in sorted(set(views))}
    for view, values in zip(views, ranked, strict=True):
        correlation[view].append(values)
    value = np.concatenate([run["vertex_score"].ravel() for run in runs])
    error = np.concatenate([run["vertex_error"].ravel() for run in runs])
    table = []
    for low, high in ((0.95, 1.01), (0.85, 0.95), (0.7, 0.85), (0.55, 0.7), (0.45, 0.55), (0.3, 0.45), (0.15, 0.3), (0.0, 0.15)):
        mine = (value >= low) & (value < high)
        if mine.sum() > 100:
            said = SETTINGS.half_error * np.sqrt(1 / np.maximum(value[mine], 1e-9) - 1)
            table.append({
                "from": low, "to": min(high, 1.0), "share": float(mine.mean()), "said_mm": 1e3 * float(np.median(said)),
                "median_mm": 1e3 * float(np.median(error[mine])), "rms_mm": 1e3 * float(np.sqrt(np.square(error[mine]).mean())),
                "below_what_is_said": float((error[mine] < said).mean()),
            })  # fmt: skip
    return {
        "within a frame": {
            "all": float(np.median(np.concatenate(ranked))),
            **{view: float(np.median(np.concatenate(values))) for view, values in correlation.items()},
        },
        "error by value": table,
    }


# Output -------------------------------------------------------------------------------------------------------------


def text(value) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {text(v)}" for name, v in value.items())
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def show(title: str, report: dict) -> None:
    print(f"\n{title}:")
    for name, value in report.items():
        if isinstance(value, list):
            for row in value:
                print(f"  {'':32s} {text(row)}")
        else:
            print(f"  {name:32s} {text(value)}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", nargs="+", help="some of them")
    parser.add_argument("--views", nargs="+", default=["full", "front"])
    parser.add_argument("--procs", type=int, default=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1)
    parser.add_argument("--frames", type=Path, help=".npz file for every frame; runs that it holds are not run again")
    parser.add_argument("--json", type=Path, help="result file")
    arguments = parsed(parser, target="json")
    report = {"commit": machine.commit(), "machine": machine.describe()}
    runs = all_runs(arguments.sequences, arguments.views, arguments.procs, arguments.frames)
    names = sorted({run["sequence"] for run in runs})
    report |= {"recordings": names, "views": sorted({view_of(run) for run in runs})}
    report |= {"product": figures(runs), "vertices": vertex_figures(runs), "paper": figures(runs, "paper")}
    for name, value in report.items():
        if isinstance(value, dict) and name != "machine":
            show(name, value)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())

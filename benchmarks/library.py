"""Benchmark of the library alone: one frame stage by stage, scaling, and growth of memory."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tracemalloc
from collections import defaultdict
from pathlib import Path

import inputs
import numpy as np

from ddakf import Config, data
from ddakf.evaluation import metrics
from ddakf.evaluation.trials.variants import ablations

CHANGES = ("without planes", "one association per frame", "without visibility", "without correlated noise",
           "without the body's motion")  # fmt: skip
WARM = 3  # frames that the times leave out: caches, and the first growth of arrays


def track(run: inputs.Run, config=None) -> dict:
    """Tracks a run: times per stage in ms, and how well the same frames were tracked."""
    tracker, laps, scores, distances = run.tracker(config), defaultdict(list), defaultdict(list), []
    for number, cloud, how in run.frames():
        result = tracker.step(cloud.points, **how)
        truth = run.sequence.garment_vertices[number]
        if number > min(WARM, len(run.clouds) - 1):
            for stage, seconds in result.timings.items():
                laps[stage].append(1e3 * seconds)
        scores["rmse_mm"].append(metrics.rmse_mm(result.vertices, truth))
        scores["normal_rmse_mm"].append(metrics.normal_rmse_mm(result.vertices, truth, run.sequence.garment_faces))
        scores["reliability"].append(result.reliability)
        scores["coverage"].append(result.coverage)
        distances.append(metrics.squared_mahalanobis(result.vertices, truth, result.covariance))
    return {
        "name": run.name,
        "vertices": tracker.garment.n_vertices,
        "points": round(float(np.mean([len(cloud.points) for cloud in run.clouds]))),
        "frames": len(run.clouds),
        "ms": {stage: percentiles(values) for stage, values in laps.items()},
        **{name: round(float(np.mean(values)), 3) for name, values in scores.items()},
        "coverage90": round(metrics.coverage90(np.concatenate(distances)), 4),
        "nees3": round(metrics.nees3(np.concatenate(distances)), 3),
    }


def percentiles(values: list[float]) -> dict[str, float]:
    return {"p50": round(float(np.percentile(values, 50)), 3), "p99": round(float(np.percentile(values, 99)), 3)}


def frames(settings) -> list[dict]:
    """Each sequence all around without, and from one depth camera with its body."""
    rows = []
    for sequence in inputs.sequences():
        rows.append(track(inputs.run_of(sequence, settings.frames, "full", settings.points)))
        rows.append(track(inputs.run_of(sequence, settings.frames, "front", settings.points, body=sequence.has_body)))
    return rows


def changes(settings) -> list[dict]:
    """The default on the sample, without each of its five changes to the paper's method, and the paper's preset."""
    variants = {"default": Config()}
    for number, (label, config) in enumerate(zip(CHANGES, ablations().values(), strict=True), 1):
        variants[f"{number}. {label}"] = config
    variants["Config.paper()"] = Config.paper()
    rows = []
    for view, body in (("full", False), ("front", True)):
        run = inputs.run_of(data.sample(), settings.change_frames, view, settings.points, body=body)
        for name, config in variants.items():
            row = {"view": run.name, "config": name}
            try:
                tracked = track(run, config)
                keys = ("rmse_mm", "normal_rmse_mm", "coverage90", "reliability")
                row |= {key: tracked[key] for key in keys} | {"ms_p50": tracked["ms"]["total"]["p50"]}
            except (np.linalg.LinAlgError, ValueError) as error:
                row["failed"] = str(error)
            rows.append(row)
    return rows


def scaling(settings) -> dict:
    """Time per frame of the sample's garment at other sizes, four or five points per vertex, and the exponent fitted to it."""
    rows = []
    for vertices, points in settings.sizes:
        sequence = inputs.resampled(inputs.shortened(data.sample(), settings.scaling_frames), vertices)
        row = track(inputs.run_of(sequence, settings.scaling_frames, "full", points))
        rows.append({key: row[key] for key in ("vertices", "points", "frames", "rmse_mm", "normal_rmse_mm")})
        rows[-1]["ms_p50"] = row["ms"]["total"]["p50"]
        rows[-1]["stages_ms_p50"] = {stage: times["p50"] for stage, times in row["ms"].items()}
    size = np.log([row["vertices"] for row in rows])
    exponent = float(np.polyfit(size, np.log([row["ms_p50"] for row in rows]), 1)[0])
    steps = [
        {
            "from": before["vertices"],
            "to": after["vertices"],
            "ratio_per_doubling": round((after["ms_p50"] / before["ms_p50"]) ** (np.log(2) / (b - a)), 3),
        }
        for before, after, a, b in zip(rows[:-1], rows[1:], size[:-1], size[1:], strict=True)
    ]
    return {"rows": rows, "exponent": round(exponent, 3), "steps": steps}


def memory(settings) -> dict:
    """Allocations of a frame by Python and NumPy: the peak beyond the memory in use before, and the memory that stays."""
    run = inputs.run_of(data.sample(), settings.memory_frames, "full", settings.points)
    tracker, peak, kept = run.tracker(), [], []
    tracemalloc.start()
    try:
        for number, cloud, how in run.frames():
            before = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            tracker.step(cloud.points, **how)
            now, most = tracemalloc.get_traced_memory()
            if number > min(WARM, len(run.clouds) - 1):
                peak.append((most - before) / 2**20)
                kept.append((now - before) / 2**20)
    finally:
        tracemalloc.stop()
    return {
        "vertices": tracker.garment.n_vertices,
        "points": settings.points,
        "peak_mib_per_frame": percentiles(peak),
        "kept_mib_per_frame": round(float(np.mean(kept)), 4),
    }


def cold(settings) -> dict:
    """A fresh process with a warm kernel cache: seconds of the import and of the first tracked frame, and its memory."""
    script = [sys.executable, str(Path(__file__).with_name("cold.py")), str(settings.points)]
    outputs = [subprocess.run(script, capture_output=True, check=True).stdout for _ in range(settings.cold_starts)]
    runs = [json.loads(output) for output in outputs]
    return {key: round(float(np.median([run[key] for run in runs])), 3) for key in runs[0]}


def growth(settings) -> dict:
    """Memory over many frames: the same clouds again and again, forth and back so that the motion stays continuous."""
    run = inputs.run_of(data.sample(), min(30, settings.growth_frames), "front", settings.points, body=True)
    tracker = run.tracker()
    seen = list(run.frames())
    order = seen + seen[-2:0:-1]
    marks = []
    for k in range(settings.growth_frames):
        _, cloud, how = order[k % len(order)]
        tracker.step(cloud.points, **(how | {"timestamp": (k + 1) / 30}))
        if k + 1 in (max(1, settings.growth_frames // 5), settings.growth_frames):
            gc.collect()
            marks.append({"frame": k + 1, "rss_kib": _resident_kib(), "python_blocks": sys.getallocatedblocks()})
    first, last = marks[0], marks[-1]
    between = max(1, last["frame"] - first["frame"])
    return {
        "frames": settings.growth_frames,
        "marks": marks,
        "rss_kib_per_1000_frames": round(1000 * (last["rss_kib"] - first["rss_kib"]) / between, 1),
        "python_blocks_per_1000_frames": round(1000 * (last["python_blocks"] - first["python_blocks"]) / between, 1),
    }


def _resident_kib() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024

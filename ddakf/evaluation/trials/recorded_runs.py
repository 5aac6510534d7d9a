"""Recorded runs: trials on real sensors' frames without vertex truth, and on pairs of frames with scene flow."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace

import numpy as np

from ddakf.evaluation import metrics, statistics
from ddakf.evaluation.datasets import Pair, Recording
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.trials.estimates import MethodFactory
from ddakf.evaluation.trials.run_score import json_numbers
from ddakf.evaluation.trials.trial import PAIR_STEPS


def recording_row(make: MethodFactory, recording: Recording, frames: range, sensor: Sensor, seed: int) -> dict:
    """Tracks a recording from a template of its first frame.

    Args:
        make: of the method, see :func:`ddakf.evaluation.trials.methods.method_factory`.
        recording: see :class:`ddakf.evaluation.datasets.Recording`.
        frames: to track; the template comes from the frame before.
        sensor: limit, drop-out, outliers and occlusion to add; the recording has noise of its cpu_started.
        seed: of its random numbers.

    Returns:
        ``frames_tracked``; means of ``residual_mm``, ``residual_p95_mm``, ``stretch_pct`` against the template and, where the
        method provides them, ``reliability``, ``paper_score`` and ``coverage``; ``own_flicker_mm``; times; ``states``; ``clips``;
        ``per_frame``.

    Raises:
        InvalidArgument: a sensor with errors of a depth camera.
    """
    sensor.require_no_camera()
    sensor = replace(sensor, noise=0.0)
    garment = recording.template(frames.start - frames.step)
    step, distance = make(garment, garment.vertices, None), metrics.SurfaceDistance(garment)
    shape = metrics.ShapeDifference(garment)
    values: dict[str, list] = {"number": [], "residual_mm": [], "residual_p95_mm": [], "stretch_pct": []}
    estimates, wall, cpu = [], [], []
    for number in frames:
        cloud = sensor.degrade(recording.cloud(number), np.random.default_rng([seed, number]), number)
        frame = CapturedFrame(number, recording.timestamp(number), cloud.points, cloud.sensor_origin)
        started, cpu_started = time.perf_counter(), time.thread_time()
        estimate = step(frame)
        wall.append(1e3 * (time.perf_counter() - started))
        cpu.append(1e3 * (time.thread_time() - cpu_started))
        residual = distance.residual(cloud.points, estimate.vertices)
        estimates.append(np.asarray(estimate.vertices, np.float32))
        values["number"].append(number)
        values["residual_mm"].append(residual.mean_mm)
        values["residual_p95_mm"].append(residual.p95_mm)
        values["stretch_pct"].append(shape.stretch(estimate.vertices, garment.vertices))
        for name in ("reliability", "paper_score", "coverage", "state"):
            if getattr(estimate, name) is not None:
                values.setdefault(name, []).append(getattr(estimate, name))
    states = values.pop("state", [])
    means = {name: float(np.nanmean(column)) for name, column in values.items() if name != "number"}
    row = {"frames_tracked": len(frames)} | means | {"own_flicker_mm": metrics.own_flicker_mm(np.array(estimates))}
    for name, column in (("wall_ms", wall), ("cpu_ms", cpu)):
        row[f"{name}_p50"], row[f"{name}_p99"] = np.percentile(column, [50, 99])
    clips = [
        {
            "first": frames[part.start],
            "frames": part.stop - part.start,
            "residual_mm": float(np.nanmean(values["residual_mm"][part])),
            "stretch_pct": float(np.nanmean(values["stretch_pct"][part])),
            "own_flicker_mm": metrics.own_flicker_mm(np.array(estimates[part])),
        }
        for part in statistics.clips(len(frames))
    ]
    row |= {"fps": 1e3 / np.mean(wall), "states": dict(Counter(states)), "clips": clips, "per_frame": values}
    return json_numbers(row)


def pair_row(make: MethodFactory, pair: Pair) -> dict:
    """Tracks the surface of a pair's first frame in the second one, which is repeated :data:`PAIR_STEPS` times.

    Returns:
        ``end_point_error_mm``, ``within_5cm``, ``residual_mm``, ``stretch_pct``, times; ``per_frame`` of the steps.
    """
    step, distance = make(pair.garment, pair.garment.vertices, None), metrics.SurfaceDistance(pair.garment)
    errors, wall = [], []
    for k in range(1, PAIR_STEPS + 1):
        frame = CapturedFrame(k, k * pair.seconds / PAIR_STEPS, pair.target.points, pair.target.sensor_origin)
        started = time.perf_counter()
        vertices = step(frame).vertices
        wall.append(1e3 * (time.perf_counter() - started))
        errors.append(metrics.end_point_error(pair.flow_of(vertices), pair.flow))
    last = errors[-1]
    row = {
        "frames_tracked": PAIR_STEPS,
        "end_point_error_mm": last.mean_mm,
        "within_5cm": last.within_5cm,
        "residual_mm": distance.residual(pair.target.points, vertices).mean_mm,
        "stretch_pct": metrics.ShapeDifference(pair.garment).stretch(vertices, pair.garment.vertices),
        "wall_ms_p50": float(np.median(wall)),
        "fps": 1e3 / float(np.mean(wall)),
        "clips": [{"first": 1, "frames": PAIR_STEPS, "end_point_error_mm": last.mean_mm}],
        "per_frame": {"number": list(range(1, PAIR_STEPS + 1)), "end_point_error_mm": [error.mean_mm for error in errors]},
    }
    return json_numbers(row)

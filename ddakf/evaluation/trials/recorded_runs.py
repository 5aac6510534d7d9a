"""Recorded runs: trials on real sensors' frames without vertex truth, and on pairs of frames with scene flow."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace

import numpy as np

from ddakf.evaluation import metrics, statistics
from ddakf.evaluation.datasets import DepthRecording, Pair, Recording
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.trials.depth_score import DepthScore
from ddakf.evaluation.trials.estimates import MethodFactory
from ddakf.evaluation.trials.run_score import json_numbers, require_finite
from ddakf.evaluation.trials.trial import PAIR_STEPS


def recording_row(make: MethodFactory, recording: Recording, frames: range, sensor: Sensor, seed: int) -> dict:
    """Tracks a recording from a template of its first frame, and then back to it.

    Args:
        make: of the method, see :func:`ddakf.evaluation.trials.methods.method_factory`.
        recording: see :class:`ddakf.evaluation.datasets.Recording`. Of depth images some columns are held out.
        frames: to track; the template comes from the frame before.
        sensor: limit, drop-out, outliers and occlusion to add; the recording has noise of its own.
        seed: of its random numbers.

    Returns:
        ``frames_tracked``; means of ``residual_mm``, ``residual_p95_mm``, ``stretch_pct`` against the template, those of
        :class:`ddakf.evaluation.trials.depth_score.DepthScore` for depth images and, where the method provides them,
        ``reliability``, ``paper_score`` and ``coverage``; ``own_flicker_mm``; times; ``states``; ``clips``; ``per_frame``; and
        ``drift_mm``, the mean distance of the vertices from the template when the recording has been played back to its frame.

    Raises:
        InvalidArgument: a sensor with errors of a depth camera.
    """
    sensor.require_no_camera()
    sensor = replace(sensor, noise=0.0)
    start = frames.start - frames.step
    garment = recording.template(start)
    images = DepthScore(recording, garment, start) if isinstance(recording, DepthRecording) else None
    recording = images.recording if images else recording
    step, distance = make(garment, garment.vertices, None), metrics.SurfaceDistance(garment)
    shape = metrics.ShapeDifference(garment)
    values: dict[str, list] = {}
    estimates, wall, cpu = [], [], []

    def frame_of(number: int, timestamp: float) -> CapturedFrame:
        cloud = sensor.degrade(recording.cloud(number), np.random.default_rng([seed, number]), number)
        return CapturedFrame(number, timestamp, cloud.points, cloud.sensor_origin)

    for number in frames:
        frame = frame_of(number, recording.timestamp(number))
        given = frame.copy()
        started, cpu_started = time.perf_counter(), time.process_time()
        estimate = step(given)
        wall.append(1e3 * (time.perf_counter() - started))
        cpu.append(1e3 * (time.process_time() - cpu_started))
        require_finite(estimate.vertices, number)
        residual = distance.residual(frame.points, estimate.vertices)
        estimates.append(np.array(estimate.vertices, np.float32))  # a method may return a buffer of its own
        scores = {"number": number, "residual_mm": residual.mean_mm, "residual_p95_mm": residual.p95_mm}
        scores |= {"stretch_pct": shape.stretch(estimate.vertices, garment.vertices)}
        scores |= images(number, estimate.vertices) if images else {}
        told = {name: getattr(estimate, name) for name in ("reliability", "paper_score", "coverage", "state")}
        for name, value in (scores | {name: value for name, value in told.items() if value is not None}).items():
            values.setdefault(name, []).append(value)
    back = [step(frame_of(number, timestamp).copy()) for number, timestamp in _backwards(recording, frames)]
    states = values.pop("state", [])
    means = {name: statistics.finite_mean(column) for name, column in values.items() if name != "number"}
    row = {"frames_tracked": len(frames)} | means
    row["own_flicker_mm"] = metrics.own_flicker_mm(np.array(estimates))
    row["drift_mm"] = metrics.MM * float(np.linalg.norm(back[-1].vertices - garment.vertices, axis=1).mean())
    for name, column in (("wall_ms", wall), ("cpu_ms", cpu)):
        row[f"{name}_p50"], row[f"{name}_p99"] = np.percentile(column, [50, 99])
    clips = [
        {
            "first": frames[part.start],
            "frames": part.stop - part.start,
            "residual_mm": statistics.finite_mean(values["residual_mm"][part]),
            "stretch_pct": statistics.finite_mean(values["stretch_pct"][part]),
            "own_flicker_mm": metrics.own_flicker_mm(np.array(estimates[part])),
        }
        for part in statistics.clips(len(frames))
    ]
    row |= {"fps": 1e3 / np.mean(wall), "states": dict(Counter(states)), "clips": clips, "per_frame": values}
    return json_numbers(row)


def _backwards(recording: Recording, frames: range) -> list[tuple[int, float]]:
    """Numbers and times of the frames from the last but one to that of the template, at the pace of the way there."""
    last = recording.timestamp(frames[-1])
    numbers = [*frames[-2::-1], frames.start - frames.step]
    return [(number, 2 * last - recording.timestamp(number)) for number in numbers]


def pair_row(make: MethodFactory, pair: Pair) -> dict:
    """Tracks the surface of a pair's first frame in the second one, which is repeated :data:`PAIR_STEPS` times.

    Returns:
        ``end_point_error_mm``, ``within_5cm``, ``residual_mm``, ``stretch_pct``, times; ``per_frame`` of the steps.
    """
    step, distance = make(pair.garment, pair.garment.vertices, None), metrics.SurfaceDistance(pair.garment)
    errors, wall = [], []
    for k in range(1, PAIR_STEPS + 1):
        frame = CapturedFrame(k, k * pair.seconds / PAIR_STEPS, pair.target.points, pair.target.sensor_origin).copy()
        started = time.perf_counter()
        vertices = step(frame).vertices
        wall.append(1e3 * (time.perf_counter() - started))
        require_finite(vertices, k)
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

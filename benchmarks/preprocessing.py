"""Comparison with Open3D: frames of the tracker and the non-rigid ICP against its preprocessing; outlier filters."""

from __future__ import annotations

import time
from collections import defaultdict
from functools import partial

import inputs
import numpy as np
from library import WARM, percentiles

import ddakf
from ddakf import Mesh, data
from ddakf.config import KnnFilter
from ddakf.errors import MissingDependency
from ddakf.evaluation.metrics import normal_rmse_mm, rmse_mm
from ddakf.evaluation.sensors import OUTLIER_MARGIN, CapturedFrame
from ddakf.evaluation.trials.methods import method_factory
from ddakf.files.open3d_bridge import import_open3d
from ddakf.garment.model import build as build_model
from ddakf.stages.preprocess import cloud as preprocessed
from ddakf.types import FrameInput

NEIGHBOURS, RATIO = 16, 2.0


def against_open3d(settings) -> dict:
    """A frame of the library, end to end, by both presets, and Open3D's outlier removal and normals, in turn on one core."""
    try:
        o3d = import_open3d()
    except MissingDependency as missing:
        return {"skipped": str(missing)}
    rows = []
    for vertices, points in settings.open3d_sizes:
        sequence = inputs.resampled(inputs.shortened(data.sample(), settings.open3d_frames), vertices)
        run = inputs.run_of(sequence, settings.open3d_frames, "full", points)
        for name, config in (("default", ddakf.Config()), ("fast", ddakf.Config.fast())):
            rows.append({"config": name, "points": points} | _beside_open3d(o3d, run, run.tracker(config)))
    return {"rows": rows, "open3d": o3d.__version__}


def _beside_open3d(o3d, run: inputs.Run, tracker: ddakf.Tracker) -> dict:
    """Times of the tracker and of Open3D's preprocessing on the same clouds, frame by frame in turn, and the tracker's errors."""
    ours, theirs, errors = [], [], []
    for number, cloud, how in run.frames():
        begun = time.perf_counter()
        result = tracker.step(cloud.points, **how)
        between = time.perf_counter()
        _open3d_preprocessing(o3d, cloud.points)
        if number > min(2, len(run.clouds) - 1):
            ours.append(1e3 * (between - begun))
            theirs.append(1e3 * (time.perf_counter() - between))
        truth = run.sequence.garment_vertices[number]
        errors.append((rmse_mm(result.vertices, truth), normal_rmse_mm(result.vertices, truth, run.sequence.garment_faces)))
    return {
        "vertices": tracker.garment.n_vertices,
        "frames": len(ours),
        "ddakf_frame_ms": percentiles(ours),
        "open3d_ms": percentiles(theirs),
        "rmse_mm": round(float(np.mean([error for error, _ in errors])), 3),
        "normal_rmse_mm": round(float(np.mean([error for _, error in errors])), 3),
        "open3d_over_ddakf": round(float(np.median(theirs) / np.median(ours)), 2),
    }


def against_icp(settings) -> list[dict]:
    """The tracker, the non-rigid ICP and Open3D's preprocessing, frame by frame in turn on the same clouds: time and error."""
    vertices, points = settings.icp_size
    sequence = inputs.resampled(inputs.shortened(data.sample(), settings.icp_frames), vertices)
    run = inputs.run_of(sequence, settings.icp_frames, "full", points)
    garment = Mesh(sequence.template, sequence.garment_faces)
    methods = {name: method_factory(name)(garment, sequence.garment_vertices[0], None) for name in ("default", "nicp", "nicp-12")}
    times, errors = defaultdict(list), defaultdict(list)

    def timed(name: str, number: int, call):
        begun = time.perf_counter()
        result = call()
        if number > min(WARM, len(run.clouds) - 1):
            times[name].append(1e3 * (time.perf_counter() - begun))
        return result

    try:
        o3d = import_open3d()
    except MissingDependency:  # then there is no ratio to it
        o3d = None
    for number, cloud, how in run.frames():
        truth = sequence.garment_vertices[number]
        frame = CapturedFrame(number, how["timestamp"], cloud.points, cloud.sensor_origin, None, truth)
        for name, step in methods.items():
            estimate = timed(name, number, partial(step, frame))
            errors[name].append(rmse_mm(estimate.vertices, truth))
        if o3d:
            timed("open3d", number, partial(_open3d_preprocessing, o3d, cloud.points))
    middle = {name: float(np.median(values)) for name, values in times.items()}
    return [
        {
            "method": name, "vertices": vertices, "points": points, "frames": len(run.clouds), "ms": percentiles(times[name]),
            "over_default": round(middle[name] / middle["default"], 2),
            "over_open3d_preprocessing": round(middle[name] / middle["open3d"], 2) if o3d else None,
            "rmse_mm": round(float(np.mean(errors[name])), 3),
        }
        for name in methods
    ]  # fmt: skip


def _open3d_preprocessing(o3d, points: np.ndarray) -> None:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    cloud, _ = cloud.remove_statistical_outlier(NEIGHBOURS, RATIO)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))


def outliers(settings) -> dict:
    """10 % of the points replaced by uniform ones around the garment: the share that each filter removes, and the good
    points that it loses."""
    try:
        o3d, why = import_open3d(), None
    except MissingDependency as missing:
        o3d, why = None, str(missing)
    sequence = inputs.shortened(data.sample(), settings.outlier_frames)
    run = inputs.run_of(sequence, settings.outlier_frames, "full", settings.points)
    area = build_model(ddakf.Mesh(sequence.template, sequence.garment_faces)).area
    default, knn = ddakf.Config(), ddakf.Config(preprocess=KnnFilter(NEIGHBOURS, RATIO))
    filters = {
        "ddakf, grid (default)": lambda points, near: _inliers(points, near, area, default),
        "ddakf, k-NN (paper)": lambda points, near: _inliers(points, near, area, knn),
    }
    if o3d:
        filters[f"Open3D ({NEIGHBOURS}, {RATIO:g})"] = lambda points, near: _open3d_inliers(o3d, points)
    tallies = {name: [] for name in filters}
    for number, cloud, _ in run.frames():
        rng = np.random.default_rng([inputs.SEED, number, 1])
        points, bad = with_outliers(cloud.points, 0.1, rng)
        near = sequence.garment_vertices[number].astype(np.float64)
        for name, inliers_of in filters.items():
            begun = time.perf_counter()
            inlier = np.zeros(len(points), bool)
            inlier[inliers_of(points, near)] = True
            tallies[name].append((1e3 * (time.perf_counter() - begun), (~inlier[bad]).mean(), (~inlier[~bad]).mean()))
    rows = [
        {
            "filter": name,
            "ms_p50": round(float(np.median([t[0] for t in tally])), 2),
            "outliers_removed": round(float(np.mean([t[1] for t in tally])), 4),
            "inliers_lost": round(float(np.mean([t[2] for t in tally])), 4),
        }
        for name, tally in tallies.items()
    ]
    return {"points": settings.points, "frames": len(run.clouds), "rows": rows} | ({"skipped": why} if why else {})


def with_outliers(points: np.ndarray, share: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The cloud with a share of its points replaced, and which ones (N,) bool."""
    bad = rng.random(len(points)) < share
    low, high = points.min(axis=0) - OUTLIER_MARGIN, points.max(axis=0) + OUTLIER_MARGIN
    return np.where(bad[:, None], rng.uniform(low, high, points.shape), points).astype(np.float32), bad


def _inliers(points: np.ndarray, near: np.ndarray, area: float, config: ddakf.Config) -> np.ndarray:
    """Indices of the points that the tracker's filter keeps."""
    return preprocessed(FrameInput(points, 0.0, None, None), near, area, config).index


def _open3d_inliers(o3d, points: np.ndarray) -> np.ndarray:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    return np.asarray(cloud.remove_statistical_outlier(NEIGHBOURS, RATIO)[1])

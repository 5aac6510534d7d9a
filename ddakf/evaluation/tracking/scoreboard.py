"""Scoreboard: the results of one run, collected per frame and summarised."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from ddakf.evaluation import metrics
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.files.io import write_mesh
from ddakf.mesh import Mesh


class Scoreboard:
    """Results of one run.

    Args:
        garment: gives the faces of the surface.
    """

    def __init__(self, garment: Mesh):
        self._faces = garment.faces
        self._distance = metrics.SurfaceDistance(garment)
        self._seconds, self._states, self._numbers, self._timestamps = [], [], [], []
        self._vertices, self._sigma, self._reliability = [], [], []
        self._rmse, self._normal, self._residual = [], [], []
        self._observed, self._hidden = [], []
        self._warned, self._warnings = Counter(), {}
        self._empty = 0

    def add(self, frame: CapturedFrame, result, seconds: float) -> None:
        """Adds one frame.

        Args:
            frame: the tracked one.
            result: a :class:`ddakf.results.FrameResult`, or a client's result with covariance.
            seconds: of the step.
        """
        self._seconds.append(seconds)
        self._states.append(result.state)
        self._numbers.append(frame.number)
        self._timestamps.append(frame.timestamp)
        self._vertices.append(np.array(result.vertices, np.float32))
        self._sigma.append(np.array(result.sigma, np.float32))
        self._reliability.append(float(result.reliability))
        self._warned.update(warning.code for warning in result.warnings)
        self._warnings |= {warning.code: warning for warning in result.warnings}
        vertices = np.asarray(result.vertices, np.float64)
        if len(frame.points):
            self._residual.append(self._distance(frame.points, vertices).astype(np.float32))
        else:
            self._empty += 1
        if frame.truth is not None:
            self._rmse.append(metrics.rmse_mm(vertices, frame.truth))
            self._normal.append(metrics.normal_rmse_mm(vertices, frame.truth, self._faces))
            covariance = np.asarray(result.covariance, np.float64)
            m = metrics.squared_mahalanobis(vertices, frame.truth, covariance)
            observed = np.asarray(result.observed, bool)
            self._observed.append(m[observed])
            self._hidden.append(m[~observed])

    def summary(self) -> dict:
        """The run in numbers; None for values that were not measured. Keys end in their unit.

        Returns:
            ``frames``; ``empty_frames``: those without points; ``states``: share of the frames in each; ``ms_p50``, ``ms_p99``:
            per frame; ``fps``: 1 / mean time; ``rmse_mm``, ``normal_rmse_mm``: means over frames; ``coverage90`` and ``nees3``:
            of all vertices pooled, with ``_observed`` and ``_hidden`` apart; ``residual_mean_mm``, ``residual_p95_mm``:
            distance of the cloud's points to the surface, pooled; ``reliability``: mean; ``warnings``: each code once, with its
            field, its last sentence and the number of its frames.
        """
        count = len(self._states)
        ms = 1e3 * np.array(self._seconds)
        residual = 1e3 * _pooled(self._residual)
        groups = {"": self._observed + self._hidden, "_observed": self._observed, "_hidden": self._hidden}
        summary = {
            "frames": count,
            "empty_frames": self._empty,
            "states": {state: n / count for state, n in Counter(self._states).most_common()},
            "ms_p50": _percentile(ms, 50),
            "ms_p99": _percentile(ms, 99),
            "fps": 1e3 / float(ms.mean()) if count else None,
            "rmse_mm": _mean(self._rmse),
            "normal_rmse_mm": _mean(self._normal),
        }
        for name, parts in groups.items():
            m = _pooled(parts)
            summary["coverage90" + name] = metrics.coverage90(m) if len(m) else None
            summary["nees3" + name] = metrics.nees3(m) if len(m) else None
        summary["residual_mean_mm"] = _mean(residual)
        summary["residual_p95_mm"] = _percentile(residual, 95)
        summary["reliability"] = _mean(self._reliability)
        summary["warnings"] = [
            {"code": code, "field": self._warnings[code].field, "message": self._warnings[code].message, "frames": n}
            for code, n in self._warned.items()
        ]
        return summary

    def save(self, path, vertex_map: np.ndarray | None = None) -> None:
        """Writes an .npz file: vertices (T, V, 3) and sigma (T, V) in metres, reliability (T,), states (T,), timestamps
        (T,) in seconds, faces (F, 3), and of a repaired template its vertex_map (V,)."""
        repaired = {} if vertex_map is None else {"vertex_map": vertex_map}
        with open(path, "wb") as file:
            np.savez_compressed(
                file,
                vertices=np.array(self._vertices),
                sigma=np.array(self._sigma),
                reliability=np.array(self._reliability, np.float32),
                states=np.array(self._states),
                timestamps=np.array(self._timestamps),
                faces=self._faces.astype(np.int32),
                **repaired,
            )

    def save_meshes(self, folder) -> list[Path]:
        """Writes the garment of each frame, in metres, as ``NUMBER.obj`` into a folder that exists; returns the files."""
        paths = [Path(folder) / f"{number:04d}.obj" for number in self._numbers]
        for path, vertices in zip(paths, self._vertices, strict=True):
            write_mesh(path, vertices, self._faces)
        return paths


def _pooled(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(parts) if parts else np.zeros(0)


def _mean(values) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _percentile(values: np.ndarray, share: float) -> float | None:
    return float(np.percentile(values, share)) if len(values) else None

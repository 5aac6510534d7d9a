"""Run score: errors, shape and calibration of a run against the truth, per frame and in summary."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np

from ddakf.evaluation import metrics, statistics
from ddakf.evaluation.metrics.calibration import NOMINAL_PROBABILITIES
from ddakf.evaluation.trials.estimates import FrameEstimate
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh

FIRST_FRAMES, LAST_FRAMES = 59, 10  # tracked frames of the means "first60" (frame 0 is the start) and "last10"
NOT_AVERAGED = ("cpu_ms", "wall_ms", "state")  # their percentiles are reported instead, or they have no mean


def require_finite(vertices: np.ndarray, number: int) -> None:
    """Raises ArithmeticError unless all coordinates are finite, in the frame of this number."""
    if not np.isfinite(vertices).all():
        raise ArithmeticError(f"vertices that are not finite in frame {number}")


class RunScore:
    """Scores of a run's frames against the truth.

    Args:
        garment: the template.
        sequence: the truth.
        surfaces: also measure Hausdorff distances and silhouettes, which takes longer than all other metrics.
    """

    def __init__(self, garment: Mesh, sequence: Sequence, *, surfaces: bool = False):
        self._garment, self._sequence, self._shape = garment, sequence, metrics.ShapeDifference(garment)
        has_body = sequence.has_body
        self._inside = metrics.Penetration(Mesh(sequence.body_vertices[0], sequence.body_faces)) if has_body else None
        self._hausdorff = metrics.Hausdorff(garment) if surfaces else None
        self.memory_mib: float | None = None  # of one frame, set by the caller who measures it
        self.numbers: list[int] = []
        self.frames: dict[str, list] = defaultdict(list)
        self._estimates: list[np.ndarray] = []
        self._groups = {name: CalibrationSums() for name in ("observed", "hidden")}

    def add(self, number: int, estimate: FrameEstimate, cpu_seconds: float, wall_seconds: float) -> None:
        """Adds one frame.

        Args:
            number: of the frame in the recording.
            estimate: of the method.
            cpu_seconds: of the processor, for the step.
            wall_seconds: of the step.

        Raises:
            ArithmeticError: vertices that are not finite.
        """
        truth, vertices = self._sequence.garment_vertices[number], np.asarray(estimate.vertices, np.float64)
        require_finite(vertices, number)
        self.numbers.append(number)
        self._estimates.append(vertices.astype(np.float32))
        values = {
            "rmse_mm": metrics.rmse_mm(vertices, truth),
            "normal_rmse_mm": metrics.normal_rmse_mm(vertices, truth, self._garment.faces),
            "tangential_rmse_mm": metrics.tangential_rmse_mm(vertices, truth, self._garment.faces),
            "stretch_pct": self._shape.stretch(vertices, self._garment.vertices),
            "stretch_truth_pct": self._shape.stretch(truth, self._garment.vertices),
            "stretch_error_pct": self._shape.stretch(vertices, truth),
            "bend_deg": self._shape.bend(vertices, self._garment.vertices),
            "bend_truth_deg": self._shape.bend(truth, self._garment.vertices),
            "bend_error_deg": self._shape.bend(vertices, truth),
            "crossings": metrics.crossings(vertices, truth, self._garment),
            "cpu_ms": 1e3 * cpu_seconds,
            "wall_ms": 1e3 * wall_seconds,
        }
        if self._hausdorff is not None:
            values["hausdorff_mm"] = self._hausdorff(vertices, truth)
            values["iou"] = metrics.silhouette_iou(vertices, truth, self._garment.faces)
        if self._inside is not None:
            body = self._sequence.body_vertices[number]
            values["penetration_mm"], values["inside"] = self._inside(vertices, body)
            values["penetration_truth_mm"], _ = self._inside(truth, body)
        for name in ("reliability", "paper_score", "coverage", "state", "effective_sample_size"):
            if getattr(estimate, name) is not None:
                values[name] = getattr(estimate, name)
        if estimate.covariance is not None:
            values |= self._calibration(vertices, truth, estimate)
        for name, value in values.items():
            self.frames[name].append(value)

    def _calibration(self, vertices: np.ndarray, truth: np.ndarray, estimate: FrameEstimate) -> dict[str, float]:
        m = metrics.squared_mahalanobis(vertices, truth, estimate.covariance)
        nll = metrics.gaussian_nll(m, estimate.covariance)
        for name, group in zip(("observed", "hidden"), (estimate.observed, ~estimate.observed), strict=True):
            self._groups[name].add(vertices[group], truth[group], m[group], nll[group])
        sigma = np.sqrt(np.trace(estimate.covariance, axis1=1, axis2=2) / 3)
        error = np.linalg.norm(vertices - truth, axis=1)
        return {"spearman_sigma": metrics.spearman(sigma, error), "coverage90": metrics.coverage90(m)}

    def summary(self) -> dict:
        """The run in numbers for JSON; None for metrics that were not measured. Keys end in their unit.

        Returns:
            ``frames_tracked``; means over frames of the per-frame values, those of the RMSE also over the first 60 and the
            last 10 frames; ``flicker_mm``, ``acceleration_variance_mm2``; ``cpu_ms_p50``, ``cpu_ms_p99``, ``wall_ms_p50``,
            ``wall_ms_p99``; ``fps``: 1 / mean time; ``memory_mib``; ``states``; ``observed`` and ``hidden``: see
            :meth:`Calibration.summary`; ``anees`` of both; ``clips``: see :meth:`clips`; ``per_frame``: arrays.
        """
        per_frame = {name: values for name, values in self.frames.items() if name not in NOT_AVERAGED}
        summary = {"frames_tracked": len(self.numbers)} | {name: _mean(values) for name, values in per_frame.items()}
        for name in ("rmse_mm", "normal_rmse_mm"):
            summary[f"{name}_first60"] = _mean(self.frames[name][:FIRST_FRAMES])
            summary[f"{name}_last10"] = _mean(self.frames[name][-LAST_FRAMES:])
        summary |= self._sequence_values(slice(None))
        for name in ("cpu_ms", "wall_ms"):
            summary[f"{name}_p50"], summary[f"{name}_p99"] = np.percentile(self.frames[name], [50, 99])
        summary["states"] = dict(Counter(self.frames["state"]))
        for name, group in self._groups.items():
            summary[name] = group.summary()
        summary["anees"] = _mean_by_count(summary["observed"], summary["hidden"], name="nees3")
        summary["fps"] = 1e3 / np.mean(self.frames["wall_ms"]) if self.numbers else None
        summary["memory_mib"] = self.memory_mib
        summary["clips"] = self.clips()
        saved = ("rmse_mm", "normal_rmse_mm", "reliability", "paper_score", "coverage", "penetration_mm", "coverage90")
        summary["per_frame"] = {"number": self.numbers} | {name: per_frame[name] for name in saved if name in per_frame}
        summary["per_frame"]["state"] = "".join(state[0] for state in self.frames["state"])
        return {name: json_numbers(value) for name, value in summary.items()}

    def clips(self) -> list[dict]:
        """The clips of :func:`ddakf.evaluation.statistics.clips`: number of the ``first`` frame, ``frames``, and the means of the
        numbers per frame."""
        clips = []
        for part in statistics.clips(len(self.numbers)):
            means = {name: _mean(values[part]) for name, values in self.frames.items() if name not in NOT_AVERAGED}
            clip = {"first": self.numbers[part.start], "frames": part.stop - part.start}
            clips.append(clip | means | self._sequence_values(part))
        return clips

    def _sequence_values(self, part: slice) -> dict[str, float]:
        """Metrics of several frames together, which are no means of values per frame."""
        estimates = np.array(self._estimates[part])
        truths = self._sequence.garment_vertices[self.numbers[part]]
        values = {
            "flicker_mm": metrics.flicker_mm(estimates, truths),
            "acceleration_variance_mm2": metrics.acceleration_variance_mm2(estimates),
            "acceleration_variance_truth_mm2": metrics.acceleration_variance_mm2(truths),
        }
        if self._inside is not None:
            depth, share = (_mean(self.frames[name][part]) for name in ("penetration_mm", "inside"))
            values["penetration_violating_mm"] = metrics.violating_mm(depth, share)
        return values


class CalibrationSums:
    """Sums over frames of the calibration of one group of vertices, which several runs can pool."""

    def __init__(self) -> None:
        self._n, self._nees, self._nll = 0, 0.0, 0.0
        self._inside, self._second = np.zeros(len(NOMINAL_PROBABILITIES)), np.zeros((3, 3))
        self._within90 = 0.0

    def add(self, vertices: np.ndarray, truth: np.ndarray, mahalanobis: np.ndarray, nll: np.ndarray) -> None:
        """The group's vertices (n, 3) of a frame, metres, with (n,) squared Mahalanobis distances and log-likelihoods."""
        n = len(vertices)
        self._n += n
        self._nees += float(mahalanobis.sum()) / 3
        self._nll += float(nll.sum())
        self._within90 += float((mahalanobis < metrics.CHI2_3_90).sum())
        probability = metrics.nominal_probability(mahalanobis)
        self._inside += (probability[:, None] <= np.array(NOMINAL_PROBABILITIES)).sum(axis=0)
        self._second += n * metrics.second_moment(vertices, truth)

    def summary(self) -> dict | None:
        """None without vertices; otherwise ``n``; ``coverage90``; ``nees3``; ``nll`` in nats; ``nll_constant``: that of the
        best constant covariance; ``second_moment``: six entries xx, xy, xz, yy, yz, zz in mm^2; ``inside``: observed share in the
        ellipsoids of the probabilities NOMINAL."""
        if self._n == 0:
            return None
        second = self._second / self._n
        return {
            "n": self._n,
            "coverage90": self._within90 / self._n,
            "nees3": self._nees / self._n,
            "nll": self._nll / self._n,
            "nll_constant": metrics.best_constant_nll(second),
            "second_moment": (1e6 * second[np.triu_indices(3)]).tolist(),
            "inside": (self._inside / self._n).tolist(),
        }


def _mean_by_count(*groups: dict | None, name: str) -> float | None:
    """The mean of a value over groups, weighted by their numbers of vertices; None without any."""
    groups = [group for group in groups if group]
    return sum(group["n"] * group[name] for group in groups) / sum(group["n"] for group in groups) if groups else None


def _mean(values: list) -> float | None:
    """The mean of the finite values: a rank correlation may be undefined in a frame."""
    values = np.array(values, np.float64)
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else None


def json_numbers(value):
    """Values for JSON: numbers with six significant digits, None for numbers that are not finite."""
    if isinstance(value, dict):
        return {name: json_numbers(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_numbers(inner) for inner in value]
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value

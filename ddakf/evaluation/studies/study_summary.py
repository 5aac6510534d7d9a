"""Summary of a study's rows: runs, mean and SD per sequence, view and system, and the tests against DD-AKF."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from ddakf.evaluation import metrics, statistics
from ddakf.evaluation.trials.run_score import json_numbers

OURS = "ddakf"
VALUES = {  # name in a result: name in a row
    "rmse_mm": "rmse_mm",
    "rmse_normal_mm": "normal_rmse_mm",
    "rmse_tangential_mm": "tangential_rmse_mm",
    "hausdorff_mm": "hausdorff_mm",
    "iou": "iou",
    "stretch_percent": "stretch_pct",
    "stretch_error_percent": "stretch_error_pct",
    "bend_deg": "bend_deg",
    "bend_error_deg": "bend_error_deg",
    "penetration_mm": "penetration_mm",
    "penetration_violating_mm": "penetration_violating_mm",
    "penetration_share": "inside",
    "flicker": "flicker_mm",
    "acceleration_variance": "acceleration_variance_mm2",
    "acceleration_variance_truth": "acceleration_variance_truth_mm2",
    "stretch_truth_percent": "stretch_truth_pct",
    "bend_truth_deg": "bend_truth_deg",
    "penetration_truth_mm": "penetration_truth_mm",
    "ms_per_frame": "wall_ms_p50",
    "ms_per_frame_p99": "wall_ms_p99",
    "cpu_ms_per_frame": "cpu_ms_p50",
    "fps": "fps",
    "memory_mib_per_frame": "memory_mib",
    "residual_mm": "residual_mm",
    "residual_p95_mm": "residual_p95_mm",
    "own_flicker": "own_flicker_mm",
    "end_point_error_mm": "end_point_error_mm",
    "within_5cm": "within_5cm",
    "coverage90": "coverage90",
    "anees": "anees",
    "spearman_sigma": "spearman_sigma",
    "reliability": "reliability",
    "effective_sample_size": "effective_sample_size",
}
CALIBRATION = ("n", "coverage90", "nees3", "inside")
PER_FRAME = ("rmse_mm", "penetration_mm", "reliability", "paper_score", "state")
TESTED = (
    "rmse_mm", "rmse_normal_mm", "hausdorff_mm", "iou", "stretch_percent", "stretch_error_percent", "bend_deg",
    "bend_error_deg", "penetration_mm", "flicker", "acceleration_variance", "residual_mm", "own_flicker", "end_point_error_mm",
)  # fmt: skip
HIGHER_IS_BETTER = ("iou",)
RECOVERED, BEFORE = 1.5, 10  # a run has recovered at this multiple of its mean error in the frames BEFORE


def summarise(rows: list[dict], meta: dict) -> dict:
    """The result of a study.

    Args:
        rows: of its trials, complete ones.
        meta: command, versions, seeds, machine.

    Returns:
        ``meta``; ``results``: by sequence, view and method ``runs`` (a value that does not apply is None), ``mean`` and ``sd``
        over them (None with one run), or ``failed`` or ``not_applicable`` with the sentence; ``p_values``: see :func:`tests`.
    """
    cells = defaultdict(list)
    for row in rows:
        cells[row["sequence"], view_of(row), row["variant"]].append(row)
    results = [_cell(*place, part) for place, part in cells.items()]
    return {"meta": meta, "results": results, "p_values": tests(rows)}


def view_of(row: dict) -> str:
    """``front+body``, for instance."""
    return row["view"] + ("+body" if row["body"] else "")


def _cell(sequence: str, view: str, method: str, rows: list[dict]) -> dict:
    cell = {"sequence": sequence, "view": view, "method": method}
    for reason in ("failed", "not_applicable"):
        if sentences := sorted({row[reason] for row in rows if reason in row}):
            cell[reason] = "; ".join(sentences)
    runs = [_run(row) for row in rows if has_result(row)]
    cell["runs"] = runs
    spreads = {name: statistics.spread([run[name] for run in runs]) for name in VALUES}
    cell["mean"] = {name: json_numbers(spread.mean) for name, spread in spreads.items()} if runs else None
    cell["sd"] = {name: json_numbers(spread.sd) for name, spread in spreads.items()} if runs else None
    return cell


def has_result(row: dict) -> bool:
    return "failed" not in row and "not_applicable" not in row


def _run(row: dict) -> dict:
    run = {"seed": row["seed"], "commit": row["commit"], "processes": row.get("processes")}
    run |= {name: row.get(key) for name, key in VALUES.items()}
    frames = row["per_frame"]
    for score in ("reliability", "paper_score"):
        for error in ("rmse_mm", "penetration_mm"):
            both = score in frames and error in frames
            value = metrics.spearman(np.array(frames[score]), np.array(frames[error])) if both else None
            run[f"spearman_{score}_{error.removesuffix('_mm')}"] = json_numbers(value)
    run["states"] = row.get("states") or None
    groups = {name: row[name] for name in ("observed", "hidden") if row.get(name)}
    run["calibration"] = {name: {key: group[key] for key in CALIBRATION} for name, group in groups.items()}
    run |= dict(zip(("recovery_frames", "recovery_ratio"), _recovery(row), strict=True))
    if row.get("occlude"):  # those of all others are in the row log
        run["per_frame"] = {"number": frames["number"]} | {name: frames[name] for name in PER_FRAME if name in frames}
    return run


def _recovery(row: dict) -> tuple[int | None, float | None]:
    """Recovery of a run after an occlusion.

    Returns:
        Frames after it until the error is within :data:`RECOVERED` times its mean of the :data:`BEFORE` frames before, None where
        it never is; and the mean error of the run's last :data:`BEFORE` frames over that before. None without an occlusion.
    """
    window, errors = row.get("occlude"), row["per_frame"].get("rmse_mm")
    if not window or errors is None:
        return None, None
    number, errors = np.array(row["per_frame"]["number"]), np.array(errors)
    before = errors[number < window[0]][-BEFORE:]
    after = errors[number >= window[1]]
    if len(before) == 0 or len(after) == 0:
        return None, None
    frames = metrics.frames_until_within(after, np.full(len(after), before.mean()), RECOVERED)
    return frames, json_numbers(after[-BEFORE:].mean() / before.mean())


def tests(rows: list[dict]) -> dict:
    """Every system against DD-AKF, paired by clip and view, over all views and in each.

    Returns:
        By ``all`` or a view, and by metric: ``comparisons`` by method, :class:`ddakf.evaluation.statistics.Comparison` with
        Holm's correction over the methods; and ``standing``, :class:`ddakf.evaluation.statistics.Standing`. Empty without DD-AKF.
    """
    rows = [row for row in rows if has_result(row)]
    if not any(row["variant"] == OURS for row in rows):
        return {}
    views = list(dict.fromkeys(map(view_of, rows)))
    parts = {"all": rows} | ({view: [row for row in rows if view_of(row) == view] for view in views} if len(views) > 1 else {})
    return {name: _tests(part) for name, part in parts.items()}


def _tests(rows: list[dict]) -> dict:
    others = [name for name in dict.fromkeys(row["variant"] for row in rows) if name != OURS]
    rmse = {name: [row["rmse_mm"] for row in rows if row["variant"] == name and "rmse_mm" in row] for name in others}
    table = {}
    for metric in TESTED:
        ours = _units(rows, OURS, metric)
        better = "higher" if metric in HIGHER_IS_BETTER else "lower"
        compared = {}
        for other in others:
            theirs = _units(rows, other, metric)
            units = sorted(set(ours) | set(theirs))
            scores = [[part.get(unit) for unit in units] for part in (ours, theirs)]
            places = [unit[0] for unit in units], [unit[2] for unit in units]
            compared[other] = statistics.compare(*scores, *places, better)
        if any(comparison.n for comparison in compared.values()):
            compared = statistics.corrected(compared)
            standing = statistics.standing(compared, rmse)
            table[metric] = {
                "comparisons": {name: comparison.as_json() for name, comparison in compared.items()},
                "standing": standing._asdict() | {"better_than_every": standing.better_than_every},
            }
    return table


def _units(rows: list[dict], method: str, metric: str) -> dict[tuple[str, str, int], float]:
    """The mean over seeds of each unit: sequence, view and first frame of the clip."""
    values = defaultdict(list)
    for row in rows:
        if row["variant"] == method:
            for clip in row["clips"]:
                values[row["sequence"], view_of(row), clip["first"]].append(clip.get(VALUES[metric]))
    return {unit: statistics.spread(part).mean for unit, part in values.items()}

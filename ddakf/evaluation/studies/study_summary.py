"""Summary of a study's rows: runs, mean and SD per sequence, view and system, and the tests against DD-AKF."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from ddakf.evaluation import metrics, statistics
from ddakf.evaluation.splits import unit_of
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
    "load_average": "load_average",
    "memory_mib_per_frame": "memory_mib",
    "residual_mm": "residual_mm",
    "residual_p95_mm": "residual_p95_mm",
    "own_flicker": "own_flicker_mm",
    "end_point_error_mm": "end_point_error_mm",
    "within_5cm": "within_5cm",
    "held_out_mm": "held_out_mm",
    "held_out_share": "held_out_share",
    "silhouette_covered": "silhouette_covered",
    "silhouette_inside": "silhouette_inside",
    "limb_mm": "limb_mm",
    "moved_limb_mm": "moved_limb_mm",
    "drift_mm": "drift_mm",
    "coverage90": "coverage90",
    "anees": "anees",
    "spearman_sigma": "spearman_sigma",
    "reliability": "reliability",
    "effective_sample_size": "effective_sample_size",
}
CALIBRATION = ("n", "coverage90", "nees3", "inside")
PER_FRAME = ("rmse_mm", "residual_mm", "penetration_mm", "reliability", "paper_score", "state",
             "held_out_share", "limb_mm", "moved_limb_mm")  # fmt: skip
TESTED = (
    "rmse_mm", "rmse_normal_mm", "hausdorff_mm", "iou", "stretch_percent", "stretch_error_percent", "bend_deg",
    "bend_error_deg", "penetration_mm", "flicker", "acceleration_variance", "residual_mm", "own_flicker", "end_point_error_mm",
    "held_out_share", "moved_limb_mm",
)  # fmt: skip
HIGHER_IS_BETTER = ("iou", "held_out_share")
KEPT = "kept"  # field of a row that stands for a run of a result
KEPT_TIMES = "kept_times"  # field of a row with the times of an earlier run, see times()
TIMES = ("ms_per_frame", "ms_per_frame_p99", "cpu_ms_per_frame", "fps", "load_average", "cpu")  # of a run, its load and machine
RECOVERED, BEFORE = 1.5, 10  # a run has recovered at this multiple of its mean error in the frames BEFORE


def summarise(rows: list[dict], meta: dict) -> dict:
    """The result of a study.

    Args:
        rows: of its trials, complete ones.
        meta: command, versions, seeds, machine.

    Returns:
        ``meta``; ``results``: by sequence, view and method ``runs`` (a value that does not apply is None), ``mean`` and ``sd``
        over them (None with one run); ``failed`` or ``not_applicable`` with the sentence where runs were, and ``failed_runs``
        with their number; ``p_values``: see :func:`tests`.
    """
    cells = defaultdict(list)
    for row in rows:
        cells[row["sequence"], view_of(row), row["variant"]].append(row)
    results = [_cell(*place, part) for place, part in cells.items()]
    return {"meta": meta, "results": results, "p_values": tests(results)}


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
    if failed := sum("failed" in row for row in rows):
        cell["failed_runs"] = failed
    spreads = {name: statistics.spread([run.get(name) for run in runs]) for name in VALUES}
    cell["mean"] = {name: json_numbers(spread.mean) for name, spread in spreads.items()} if runs else None
    cell["sd"] = {name: json_numbers(spread.sd) for name, spread in spreads.items()} if runs else None
    return cell


def has_result(row: dict) -> bool:
    return "failed" not in row and "not_applicable" not in row


def times(row: dict) -> dict:
    """The times of a row as a field of a later row of the same trial, with their commit; nothing where it has none."""
    if not {KEPT, "per_frame"} & set(row):  # one that failed has those that were kept for it
        return {KEPT_TIMES: row[KEPT_TIMES]} if KEPT_TIMES in row else {}
    run = _run(row)
    return {KEPT_TIMES: {"times_commit": run["commit"]} | {name: run[name] for name in (*TIMES, "times_commit") if name in run}}


def _run(row: dict) -> dict:
    if KEPT in row:
        return row[KEPT]
    run = {"seed": row["seed"], "commit": row["commit"], "processes": row.get("processes"), "seconds": row.get("seconds")}
    run |= {name: row[name] for name in ("inputs", "cpu") if name in row}
    run |= {name: row.get(key) for name, key in VALUES.items()} | row.get(KEPT_TIMES, {})
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
    if row.get("occlude") or "residual_mm" in frames:  # those of all others are in the row log
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


def tests(cells: list[dict]) -> dict:
    """Every system against DD-AKF, paired by :func:`ddakf.evaluation.splits.unit_of`, over all views and in each.

    Args:
        cells: of a study, by sequence, view and method.

    Returns:
        By ``all`` or a view, and by metric: ``comparisons`` by method, :class:`ddakf.evaluation.statistics.Comparison` with
        Holm's correction over the methods; and ``standing``, :class:`ddakf.evaluation.statistics.Standing`. Empty without DD-AKF.
    """
    if not any(cell["method"] == OURS and cell["mean"] for cell in cells):
        return {}
    views = list(dict.fromkeys(cell["view"] for cell in cells))
    parts = {"all": cells}
    if len(views) > 1:
        parts |= {view: [cell for cell in cells if cell["view"] == view] for view in views}
    return {name: _tests(part) for name, part in parts.items()}


def _tests(cells: list[dict]) -> dict:
    measured = [cell for cell in cells if cell["mean"]]
    others = [name for name in dict.fromkeys(cell["method"] for cell in measured) if name != OURS]
    rmse = {name: _errors_of_runs([cell for cell in cells if cell["method"] == name]) for name in others}
    table = {}
    for metric in TESTED:
        better = "higher" if metric in HIGHER_IS_BETTER else "lower"
        compared = {}
        for other in others:
            ours, theirs = paired(measured, OURS, metric), paired(measured, other, metric)
            views = {place: None for place in ours if place in theirs}  # of the cells that both have
            none = {unit_of(sequence): None for sequence, _ in ours | theirs}  # where only one has any
            compared[other] = statistics.compare(none | by_unit(ours, views), none | by_unit(theirs, views), better)
        if any(comparison.n for comparison in compared.values()):
            compared = statistics.corrected(compared)
            standing = statistics.standing(compared, rmse)
            table[metric] = {
                "comparisons": {name: comparison.as_json() for name, comparison in compared.items()},
                "standing": standing._asdict() | {"better_than_every": standing.better_than_every},
            }
    return table


def _errors_of_runs(cells: list[dict]) -> list[float | None]:
    """The RMSE of each run of a method, mm; None for one that failed. Empty where no run has a truth."""
    errors = [run["rmse_mm"] for cell in cells for run in cell["runs"] if run["rmse_mm"] is not None]
    return errors + [None] * sum(cell.get("failed_runs", 0) for cell in cells) if errors else []


def paired(cells: list[dict], method: str, metric: str) -> dict[tuple[str, str], float]:
    """The mean over seeds of a method's metric by sequence and view, where there is one."""
    return {
        (cell["sequence"], cell["view"]): cell["mean"][metric]
        for cell in cells
        if cell["method"] == method and cell["mean"] and cell["mean"].get(metric) is not None
    }


def by_unit(values: dict[tuple[str, str], float], places: Iterable[tuple[str, str]]) -> dict[str, float]:
    """The mean over the places (sequence, view) of each unit."""
    parts = defaultdict(list)
    for place in places:
        parts[unit_of(place[0])].append(values[place])
    return {unit: float(np.mean(part)) for unit, part in parts.items()}

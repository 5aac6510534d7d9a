"""Accuracy tables: rows of :mod:`ddakf.evaluation.trials.runs` as Markdown tables."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable

import numpy as np

from ddakf.evaluation.splits import turns_unseen
from ddakf.evaluation.trials.calibration_pools import by_kind, calibrated, mean, pooled, view_of, with_mask
from ddakf.evaluation.trials.methods import BASELINES

CONVERGED_WITHIN = 15  # frames in which a run from a random start must converge
RECOVERED_WITHIN = 10  # frames in which a run must recover from a disturbance
SUMMARISED = ("default", "paper", *BASELINES)  # variants with all metrics in the summary; the others have the errors only
ACCURACY = (  # heading, key, decimals
    ("normal", "normal_rmse_mm", 1),
    ("first 60", "rmse_mm_first60", 1),
    ("last 10", "rmse_mm_last10", 1),
    ("flicker", "flicker_mm", 1),
    ("ms p50", "cpu_ms_p50", 0),
    ("p99", "cpu_ms_p99", 0),
)
SHAPE = (
    ("penetration mm", "penetration_mm", 2),
    ("of truth", "penetration_truth_mm", 2),
    ("crossings", "crossings", 1),
    ("stretch %", "stretch_pct", 1),
    ("of truth", "stretch_truth_pct", 1),
    ("against truth", "stretch_error_pct", 1),
    ("bend deg", "bend_deg", 1),
    ("of truth", "bend_truth_deg", 1),
    ("against truth", "bend_error_deg", 1),
)


def report(rows: list[dict]) -> str:
    """All tables for which there are rows."""
    grid, starts, disturbed = by_kind(rows)
    parts = [
        ("Accuracy", accuracy(grid)),
        ("Shape and contact", shape(grid)),
        ("Ablation: RMSE / normal RMSE, mm", ablation(grid)),
        ("Calibration", calibration(grid)),
        ("Points of the whole person", unsegmented(grid)),
        ("Starts off the truth", converged(starts)),
        ("Disturbances", recovered(disturbed)),
    ]
    failures = [f"- {row['sequence']} {view_of(row)} {row['variant']}: {row['failed']}" for row in rows if "failed" in row]
    text = "\n\n".join(f"## {title}\n\n{table}" for title, table in parts if table)
    return text + ("\n\nFailed:\n" + "\n".join(failures) if failures else "")


def accuracy(rows: list[dict], variant: str = "default") -> str:
    """A variant per sequence and view, means over the seeds, with the non-rigid ICP's of the same clouds beside it."""
    ours = _by(rows, lambda row: (row["sequence"], view_of(row)), variant)
    other = _by(rows, lambda row: (row["sequence"], view_of(row)), "nicp")
    lines = []
    for (sequence, view), runs in ours.items():
        nicp = other.get((sequence, view), [])
        both = f"{_number(mean(nicp, 'rmse_mm'))} / {_number(mean(nicp, 'normal_rmse_mm'))}" if nicp else ""
        values = [_number(mean(runs, key), decimals) for _, key, decimals in ACCURACY]
        lines.append([sequence, view, str(len(runs)), _spread(runs, "rmse_mm"), *values, _states(runs), both])
    heads = ["sequence", "view", "runs", "RMSE mm", *(head for head, _, _ in ACCURACY), "states", "nicp RMSE / normal"]
    return _markdown(heads, lines)


def shape(rows: list[dict]) -> str:
    """Penetration into the body, crossings of layers, strain and bending, of the estimate beside the truth's own."""
    cells = _by(rows, lambda row: (row["sequence"], view_of(row), row["variant"].partition("=")[0]))
    lines = []
    for place, runs in sorted(cells.items()):
        values = [mean(runs, key) for _, key, _ in SHAPE]
        if any(value is not None for value in values):
            texts = [_number(value, decimals) for value, (_, _, decimals) in zip(values, SHAPE, strict=True)]
            lines.append([*place, str(len(runs)), *texts])
    return _markdown(["sequence", "view", "variant", "runs", *(head for head, _, _ in SHAPE)], lines)


def ablation(rows: list[dict]) -> str:
    """Every variant on every sequence and view."""
    cells = _by(rows, lambda row: (row["variant"].partition("=")[0], row["sequence"], view_of(row)))
    variants = list(dict.fromkeys(key[0] for key in cells))
    if len(variants) < 2:
        return ""
    lines = []
    for place in dict.fromkeys(key[1:] for key in cells):
        runs = [cells.get((variant, *place), []) for variant in variants]
        lines.append([*place, *(_pair(part) if part else "" for part in runs)])
    return _markdown(["sequence", "view", *variants], lines)


def calibration(rows: list[dict], variant: str = "default") -> str:
    """:func:`calibrated` as a table."""
    lines = [
        [
            part["runs"], part["group"], f"{part['n']:,}", f"{part['coverage90']:.1%}", f"{part['nees3']:.2f}",
            f"{part['nll_excess']:+.2f}", _number(part["spearman_front"], 2),
        ]
        for part in calibrated(rows, variant)
    ]  # fmt: skip
    heads = ["runs", "group", "vertices", "in 90 %", "NEES/3", "NLL less best constant's", "Spearman(sigma, error), front"]
    return _markdown(heads, lines)


def unsegmented(rows: list[dict], variant: str = "default") -> str:
    """The error with the points of the whole person over that with the garment's alone."""
    cells = _by(rows, lambda row: (row["sequence"], view_of(row | {"segmented": True}), row["segmented"]), variant)
    lines = []
    for place in dict.fromkeys(key[:2] for key in cells):
        alone, person = (mean(cells.get((*place, segmented), []), "rmse_mm") for segmented in (True, False))
        if alone is not None and person is not None:
            lines.append([*place, _number(alone), _number(person), f"{person / alone:.2f}"])
    return _markdown(["sequence", "view", "garment alone, RMSE mm", "whole person", "ratio"], lines)


def recovered(rows: list[dict]) -> str:
    """The number of disturbed runs within 1.5 times the undisturbed run's error after at most 10 frames."""
    lines = []
    for (variant, what), runs in _by(rows, lambda row: (row["variant"].partition("=")[0], row["disturbance"])).items():
        slow = [row for row in runs if not _soon(row, "rmse_mm", RECOVERED_WITHIN)]
        taken = sorted(row.get("frames_until_rmse_mm") or np.inf for row in runs)
        lost = sum("lost" in row.get("states", {}) for row in runs)
        exceptions = ", ".join(f"{row['sequence']} {view_of(row)} ({row.get('frames_until_rmse_mm')})" for row in slow)
        back = f"{len(runs) - len(slow)} of {len(runs)}"
        lines.append([variant, what, back, f"{taken[len(taken) // 2]:.0f}", str(lost), exceptions])
    heads = ["variant", "disturbance", "back within 10 frames", "median frames", "runs declared lost", "later (frames)"]
    return _markdown(heads, lines)


def converged(rows: list[dict]) -> str:
    """The number of runs from random starts that converged within 15 frames."""
    lines = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        runs = [row for row in rows if row["variant"] == variant]
        for name in ["all", *dict.fromkeys(row["sequence"] for row in runs)]:
            chosen = [row for row in runs if name in ("all", row["sequence"])]
            count = sum(map(success, chosen))
            normal = sum(_soon(row, "normal_rmse_mm") for row in chosen)
            lines.append([variant, name, str(len(chosen)), f"{count} ({count / len(chosen):.0%})", str(normal)])
    return _markdown(["variant", "sequence", "starts", "converged", "of the normal RMSE alone"], lines)


def success(row: dict) -> bool:
    """True if a run from a random start converged in normal RMSE, and in vertex RMSE if the garment is asymmetric."""
    return _soon(row, "normal_rmse_mm") and (turns_unseen(row["sequence"]) or _soon(row, "rmse_mm"))


def summary(rows: list[dict]) -> dict:
    """Summary of a file of rows: means per sequence, view and variant, and the pooled calibration."""
    grid, starts, disturbed = by_kind(rows)
    keys = ("rmse_mm", *(key for _, key, _ in (*ACCURACY, *SHAPE)), "spearman_sigma")
    runs = []
    for (sequence, view, variant), part in _by(grid, lambda row: (row["sequence"], view_of(row), row["variant"])).items():
        wanted = keys if variant in SUMMARISED else ("rmse_mm", "normal_rmse_mm")
        means = {key: _rounded(mean(part, key)) for key in wanted}
        runs.append({"sequence": sequence, "view": view, "variant": variant, "runs": len(part)} | means)
    pools = pooled(with_mask(grid, "default"))
    return {
        "commits": sorted({str(row.get("commit")) for row in rows}),
        "runs": runs,
        "calibration": {group: {name: _rounded(value) for name, value in pool.items()} for group, pool in pools.items()},
        "starts": _counts(starts, lambda row: row["variant"], success),
        "disturbances": _counts(
            disturbed, lambda row: f"{row['variant']}, {row['disturbance']}", lambda row: _soon(row, "rmse_mm", RECOVERED_WITHIN)
        ),
    }


def _soon(row: dict, name: str, within: int = CONVERGED_WITHIN) -> bool:
    taken = row.get(f"frames_until_{name}")
    return taken is not None and taken <= within


def _counts(rows: list[dict], key: Callable[[dict], str], good: Callable[[dict], bool]) -> dict[str, dict[str, int]]:
    return {name: {"runs": len(part), "good": sum(map(good, part))} for name, part in _by(rows, key).items()}


def _by(rows: Iterable[dict], key: Callable[[dict], tuple], variant: str | None = None) -> dict[tuple, list[dict]]:
    groups = defaultdict(list)
    for row in rows:
        if variant in (None, row["variant"]):
            groups[key(row)].append(row)
    return dict(sorted(groups.items(), key=lambda item: [str(part) for part in item[0]][-2:])) if variant else dict(groups)


def _pair(rows: list[dict]) -> str:
    if all("failed" in row for row in rows):
        return "failed"
    return f"{_number(mean(rows, 'rmse_mm'))} / {_number(mean(rows, 'normal_rmse_mm'))}"


def _spread(rows: list[dict], key: str) -> str:
    """Mean, and the standard deviation over runs where there are several."""
    values = [row[key] for row in rows if row.get(key) is not None]
    return f"{np.mean(values):.1f} ± {np.std(values, ddof=1):.1f}" if len(values) > 1 else _number(mean(rows, key))


def _states(rows: list[dict]) -> str:
    """Shares of the frames that were not tracked."""
    count = defaultdict(int)
    for row in rows:
        for state, frames in row.get("states", {}).items():
            count[state] += frames
    total = sum(count.values())
    return ", ".join(f"{state} {n / total:.0%}" for state, n in count.items() if state != "tracking")


def _number(value: float | None, decimals: int = 1) -> str:
    return "" if value is None else f"{value:.{decimals}f}"


def _rounded(value):
    if isinstance(value, list):
        return [_rounded(inner) for inner in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _markdown(heads: list[str], lines: list[list[str]]) -> str:
    if not lines:
        return ""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [heads, ["---"] * len(heads), *lines])

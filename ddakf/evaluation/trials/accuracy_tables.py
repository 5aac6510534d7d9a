"""Rows of :mod:`ddakf.evaluation.trials.runs`, pooled and written as Markdown tables."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from scipy.stats import chi2

from ddakf.evaluation import metrics
from ddakf.evaluation.metrics.calibration import NOMINAL_PROBABILITIES
from ddakf.evaluation.trials.methods import BASELINES

GROUPS = ("observed", "hidden, body given", "hidden, no body")
WITHIN = 15  # frames in which a run from a random start shall converge
BACK = 10  # frames in which a run shall be itself again after a disturbance
# Garments on which sleeves or legs tell where the template's vertices belong; skirts and tank tops turn unnoticed
ASYMMETRIC = ("sample", "pergamo_005", "sim_tshirt_jump", "samba_whole")
IN_FULL = ("default", "paper", *BASELINES)  # of the other variants, summaries keep the errors only
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


def view_of(row: dict) -> str:
    """``front+body``, for instance."""
    return row["view"] + ("+body" if row["body"] else "") + ("" if row["segmented"] else ", unsegmented")


def mean(rows: list[dict], key: str) -> float | None:
    """Over the rows that did not fail and have a value."""
    values = [row[key] for row in rows if row.get(key) is not None]
    return float(np.mean(values)) if values else None


def report(rows: list[dict]) -> str:
    """All tables that the rows can fill."""
    grid, starts, disturbed = kinds(rows)
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


def kinds(rows: list[dict]) -> tuple[list[dict], list[dict], list[dict]]:
    """Runs of the grid, runs from starts off the truth, and disturbed runs."""
    grid, starts, disturbed = [], [], []
    for row in rows:
        (starts if row["start"] is not None else disturbed if row["disturbance"] is not None else grid).append(row)
    return grid, starts, disturbed


def accuracy(rows: list[dict], variant: str = "default") -> str:
    """A variant per sequence and view, means over the seeds, with the non-rigid ICP's of the same clouds beside it."""
    ours = _by(rows, lambda row: (row["sequence"], view_of(row)), variant)
    other = _by(rows, lambda row: (row["sequence"], view_of(row).replace("+body", "")), "nicp")
    lines = []
    for (sequence, view), runs in ours.items():
        nicp = other.get((sequence, view.replace("+body", "")), [])
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


def calibration(rows: list[dict], variant: str = "default", scale: Mapping[str, float] | None = None) -> str:
    """:func:`calibrated` as a table."""
    lines = [
        [
            part["runs"], part["group"], f"{part['n']:,}", f"{part['coverage90']:.1%}", f"{part['nees3']:.2f}",
            f"{part['nll_excess']:+.2f}", _number(part["spearman_front"], 2),
        ]
        for part in calibrated(rows, variant, scale)
    ]  # fmt: skip
    heads = ["runs", "group", "vertices", "in 90 %", "NEES/3", "NLL less best constant's", "Spearman(sigma, error), front"]
    return _markdown(heads, lines)


def calibrated(rows: list[dict], variant: str = "default", scale: Mapping[str, float] | None = None) -> list[dict]:
    """Claimed covariances pooled over runs with a mask: all, each half of the sequences, each view and each sequence.

    Args:
        rows: of trials.
        variant: of the method.
        scale: by group, factor on the claimed standard deviations, see :func:`rescaled`; 1 where there is none.

    Returns:
        By part of the runs and by group: ``runs``, ``group``, ``n``, ``coverage90``, ``nees3``, ``nll_excess`` over the best
        constant covariance's, and ``spearman_front``: mean rank correlation of sigma and error within frames, single view.
    """
    rows = _with_mask(rows, variant)
    halves = half_of(rows)
    parts: list[tuple[str, Callable[[dict], bool]]] = [("all", lambda row: True)]
    if all(halves):
        parts += [(", ".join(half), lambda row, half=half: row["sequence"] in half) for half in halves]
    parts += [(view, lambda row, view=view: view_of(row) == view) for view in dict.fromkeys(map(view_of, rows))]
    parts += [(name, lambda row, name=name: row["sequence"] == name) for name in sorted([*halves[0], *halves[1]]) if all(halves)]
    pools = []
    for name, belongs in parts:
        chosen = [row for row in rows if belongs(row)]
        single = [row for row in chosen if row["view"] == "front"]
        spearman = mean(single, "spearman_sigma") if single else None
        for group, pool in pooled(chosen).items():
            pool = rescaled(pool, (scale or {}).get(group, 1.0))
            pools.append({
                "runs": name, "group": group, "n": pool["n"], "coverage90": pool["coverage90"], "nees3": pool["nees3"],
                "nll_excess": pool["nll"] - pool["nll_constant"], "spearman_front": spearman,
            })  # fmt: skip
    return pools


def half_of(rows: Iterable[dict]) -> tuple[list[str], list[str]]:
    """Every second sequence, on which constants are fitted, and the others."""
    sequences = sorted({row["sequence"] for row in rows})
    return sequences[::2], sequences[1::2]


def rescaled(pool: dict, scale: float) -> dict:
    """A pool of :func:`pooled` as it were with ``scale`` times the claimed standard deviations.

    With m the squared Mahalanobis distances, NEES is mean(m) / scale^2 and the log-likelihood changes by 3 log(scale) + mean(m)
    (1 / scale^2 - 1) / 2, exactly; the shares in ellipsoids are read between those of the probabilities NOMINAL.
    """
    if scale == 1.0:
        return pool
    nominal, inside = [0.0, *NOMINAL_PROBABILITIES, 1.0], [0.0, *pool["inside"], 1.0]
    shares = np.interp(chi2.cdf(scale**2 * chi2.ppf([*NOMINAL_PROBABILITIES, 0.9], 3), 3), nominal, inside).tolist()
    return pool | {
        "inside": shares[:-1],
        "coverage90": shares[-1],
        "nees3": pool["nees3"] / scale**2,
        "nll": pool["nll"] + 3 * float(np.log(scale)) + 1.5 * pool["nees3"] * (1 / scale**2 - 1),
    }


def pooled(rows: Iterable[dict]) -> dict[str, dict]:
    """Calibration by group over all vertices, frames and runs: ``n``, ``coverage90``, ``nees3``, ``nll``, ``inside``, and
    ``nll_constant``, of the one covariance that suits the group best in all these runs."""
    parts = defaultdict(list)
    for row in rows:
        if row.get("observed"):
            parts["observed"].append(row["observed"])
        if row.get("hidden"):
            parts["hidden, body given" if row["body"] else "hidden, no body"].append(row["hidden"])
    pools = {}
    for group in GROUPS:
        if parts[group]:
            n = np.array([part["n"] for part in parts[group]], float)
            pool = {
                name: (np.array([part[name] for part in parts[group]]).T @ n / n.sum()).tolist()
                for name in ("coverage90", "nees3", "nll", "inside", "second_moment")
            }
            second = np.zeros((3, 3))
            second[np.triu_indices(3)] = np.array(pool.pop("second_moment")) / 1e6
            second = second + np.triu(second, 1).T
            pools[group] = pool | {"n": int(n.sum()), "nll_constant": metrics.best_constant_nll(second)}
    return pools


def reliability_curves(
    rows: Iterable[dict], variant: str = "default", scale: Mapping[str, float] | None = None
) -> dict[str, tuple[tuple[float, ...], list[float]]]:
    """Nominal probabilities and observed shares by group, for the reliability diagram."""
    pools = pooled(_with_mask(kinds(list(rows))[0], variant))
    pools = {group: rescaled(pool, (scale or {}).get(group, 1.0)) for group, pool in pools.items()}
    return {group: (NOMINAL_PROBABILITIES, pool["inside"]) for group, pool in pools.items()}


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
    """Of the disturbed runs, how many were within 1.5 times the undisturbed run's error after at most 10 frames."""
    lines = []
    for (variant, what), runs in _by(rows, lambda row: (row["variant"].partition("=")[0], row["disturbance"])).items():
        slow = [row for row in runs if not _soon(row, "rmse_mm", BACK)]
        taken = sorted(row.get("frames_until_rmse_mm") or np.inf for row in runs)
        lost = sum("lost" in row.get("states", {}) for row in runs)
        exceptions = ", ".join(f"{row['sequence']} {view_of(row)} ({row.get('frames_until_rmse_mm')})" for row in slow)
        back = f"{len(runs) - len(slow)} of {len(runs)}"
        lines.append([variant, what, back, f"{taken[len(taken) // 2]:.0f}", str(lost), exceptions])
    heads = ["variant", "disturbance", "back within 10 frames", "median frames", "runs declared lost", "later (frames)"]
    return _markdown(heads, lines)


def converged(rows: list[dict]) -> str:
    """Of the runs from random starts, how many converged within 15 frames."""
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
    """A run from a random start converged: in normal RMSE, and in vertex RMSE where sleeves or legs fix the vertices."""
    return _soon(row, "normal_rmse_mm") and (row["sequence"] not in ASYMMETRIC or _soon(row, "rmse_mm"))


def summary(rows: list[dict]) -> dict:
    """What is worth keeping of a file of rows: means per sequence, view and variant, and the pooled calibration."""
    grid, starts, disturbed = kinds(rows)
    keys = ("rmse_mm", *(key for _, key, _ in (*ACCURACY, *SHAPE)), "spearman_sigma")
    runs = []
    for (sequence, view, variant), part in _by(grid, lambda row: (row["sequence"], view_of(row), row["variant"])).items():
        wanted = keys if variant in IN_FULL else ("rmse_mm", "normal_rmse_mm")
        means = {key: _rounded(mean(part, key)) for key in wanted}
        runs.append({"sequence": sequence, "view": view, "variant": variant, "runs": len(part)} | means)
    pools = pooled(_with_mask(grid, "default"))
    return {
        "commits": sorted({str(row.get("commit")) for row in rows}),
        "runs": runs,
        "calibration": {group: {name: _rounded(value) for name, value in pool.items()} for group, pool in pools.items()},
        "starts": _counts(starts, lambda row: row["variant"], success),
        "disturbances": _counts(
            disturbed, lambda row: f"{row['variant']}, {row['disturbance']}", lambda row: _soon(row, "rmse_mm", BACK)
        ),
    }


def _soon(row: dict, name: str, within: int = WITHIN) -> bool:
    taken = row.get(f"frames_until_{name}")
    return taken is not None and taken <= within


def _with_mask(rows: list[dict], variant: str) -> list[dict]:
    return [row for row in rows if row["variant"] == variant and row["segmented"] and "failed" not in row]


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

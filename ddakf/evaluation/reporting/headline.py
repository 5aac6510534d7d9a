"""Headline: every system in the three conditions on one screen, and the ratio of the best baseline's error to DD-AKF's."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ddakf.evaluation import statistics
from ddakf.evaluation.metrics.calibration import NOMINAL_PROBABILITIES
from ddakf.evaluation.paper_scope import CONDITIONS, REFERENCES, TITLES, ordered
from ddakf.evaluation.reporting.paper_tables import Cell, Table
from ddakf.evaluation.reporting.result_files import Result
from ddakf.evaluation.studies.study_summary import OURS, by_unit, paired

VALUES = {"rmse_mm": ("RMSE", 1), "rmse_normal_mm": ("normal", 1), "cpu_ms_per_frame": ("ms", 0)}
GROUPS, HELD = ("observed", "hidden"), (0.5, 0.9)  # of vertices; levels of the ellipsoids
TINY = 1e-6  # of a time that is none
FEWER = "* the mean of fewer sequences: on the others the system does not apply or failed."
NOT_RIVALS = (OURS, "paper", "printed", *REFERENCES)


def table(result: Result, name: str = "headline", title: str = "Headline") -> Table:
    """Systems down; RMSE, normal RMSE and processor time per frame in each condition across, and below them the ratio."""
    views = [view for view in CONDITIONS if view in result.views]
    systems = ordered(result.methods)
    means = {(m, v, value): geometric_mean(result, m, v, value) for m in systems for v in views for value in VALUES}
    partial = {(m, view) for m in systems for view in views if _partial(result, m, view)}
    whole = {view: [m for m in systems if (m, view) not in partial] for view in views}
    best = {(v, value): _least(means, whole[v], v, value) for v in views for value in ("rmse_mm", "rmse_normal_mm")}
    columns = [(view, value) for view in views for value in VALUES]
    first = next(iter(VALUES))
    heads = ["system", *((f"{CONDITIONS[v]}: " if value == first else "") + VALUES[value][0] for v, value in columns)]
    rows = [
        [Cell(TITLES.get(m, m)), *(_cell(means[m, v, x], x, best.get((v, x)) == m, (m, v) in partial) for v, x in columns)]
        for m in systems
    ]
    rows += [_ratios("best baseline / DD-AKF, RMSE", result, views, "rmse_mm"),
             _ratios("best baseline / DD-AKF, normal RMSE", result, views, "rmse_normal_mm")]  # fmt: skip
    loads = [run["load_average"] for cell in result.cells for run in cell["runs"] if run.get("load_average") is not None]
    notes = [
        f"{len(result.sequences)} sequences, seeds {', '.join(map(str, result.meta['seeds']))}, frames {result.meta['frames']}. "
        "Geometric means over the sequences, in mm; milliseconds of one core per frame, medians.",
        "With the body, every baseline that can use one does: predictions carried, hidden vertices held, no penetration.",
        "The best baseline is the one with the least geometric mean in that condition; its ratio has a 95 % interval by a "
        "bootstrap over the sequences.",
        "Times compare implementations too: DD-AKF's kernels are compiled, the baselines are NumPy and SciPy.",
    ]  # fmt: skip
    best_of_each = [f"{ratio:.2f}" for view in views if (ratio := best_of_each_ratio(result, view)) is not None]
    if best_of_each:
        notes.append(f"Against the best baseline of each sequence the ratios of the RMSE are {', '.join(best_of_each)}.")
    notes += [sentence for view in views for sentence in _not_first(result, view)]
    if partial:
        notes += [f"{TITLES.get(m, m)}: {result.reason(m)}" for m in systems if any((m, view) in partial for view in views)]
        notes.append(FEWER)
    if loads:
        notes.append(f"Load average while the runs ended: {min(loads):.1f} to {max(loads):.1f}.")
    return Table(name, title, heads, rows, notes, [result])


def calibration(results: Iterable[Result]) -> Table:
    """DD-AKF's ellipsoids: by study and condition the share of the seen and of the hidden vertices inside, and NEES/3."""
    heads, rows, sources = ["study, condition"], [], {}
    for group in GROUPS:
        heads += [f"{group}: in the 50 % ellipsoids", "90 %", "NEES/3"]
    for result in results:
        for view in (view for view in CONDITIONS if view in result.views):
            runs = [run for cell in _of(result, view) if cell["method"] == OURS for run in cell["runs"]]
            parts = [[run["calibration"][group] for run in runs if (run.get("calibration") or {}).get(group)] for group in GROUPS]
            if any(parts):
                cells = [cell for part in parts for cell in _held(part)]
                rows.append([Cell(f"{result.name}, {CONDITIONS[view]}"), *cells])
                sources[result.name] = result
    notes = ["Pooled over vertices, frames, recordings and seeds. A share above the level is a claim that is too wide."]
    return Table("calibration", "Calibration", heads, rows, notes, list(sources.values()))


def _held(part: list[dict]) -> list[Cell]:
    """Shares inside at both levels and NEES/3 of these pools, weighted by their vertices."""
    if not part:
        return [Cell("–", kind="none")] * (len(HELD) + 1)
    weights = [pool["n"] for pool in part]
    inside = np.average([pool["inside"] for pool in part], axis=0, weights=weights)
    nees = np.average([pool["nees3"] for pool in part], weights=weights)
    return [*(Cell(f"{np.interp(level, NOMINAL_PROBABILITIES, inside):.0%}") for level in HELD), Cell(f"{nees:.2f}")]


def geometric_mean(result: Result, system: str, view: str, value: str) -> float | None:
    """Geometric mean over the sequences (FAUST: subjects) of a system's value in a view."""
    found = _by_unit(result, system, view, value)
    return float(np.exp(np.mean(np.log(np.maximum(list(found.values()), TINY))))) if found else None


def arithmetic_mean(result: Result, system: str, view: str, value: str) -> float:
    """Mean over the sequences (FAUST: subjects) of a system's value in a view."""
    return float(np.mean(list(_by_unit(result, system, view, value).values())))


def best_baseline(result: Result, view: str, value: str = "rmse_mm") -> tuple[str, statistics.Ratio] | None:
    """The baseline with the least geometric mean of those that ran on all sequences, and the ratio of its error to DD-AKF's."""
    ours = _by_unit(result, OURS, view, value)
    means = {m: geometric_mean(result, m, view, value) for m in result.methods if m not in NOT_RIVALS}
    means = {m: mean for m, mean in means.items() if mean is not None and len(_by_unit(result, m, view, value)) >= len(ours)}
    if not ours or not means:
        return None
    name = min(means, key=means.get)
    return name, statistics.ratio(ours, _by_unit(result, name, view, value))


def best_of_each_ratio(result: Result, view: str, value: str = "rmse_mm") -> float | None:
    """Geometric mean over the sequences of the least value of any baseline over DD-AKF's: no system has it."""
    ours, rivals = _by_unit(result, OURS, view, value), [m for m in result.methods if m not in NOT_RIVALS]
    found = [_by_unit(result, m, view, value) for m in rivals]
    least = {unit: min(each[unit] for each in found if unit in each) for unit in ours if any(unit in each for each in found)}
    return float(np.exp(np.mean([np.log(least[unit] / ours[unit]) for unit in least]))) if least else None


def better_baselines(result: Result, view: str, value: str = "rmse_mm") -> dict[str, tuple[float, str, float]]:
    """By sequence (FAUST: subject) on which some baseline has less than DD-AKF: DD-AKF's value, that baseline and its value."""
    ours = _by_unit(result, OURS, view, value)
    rivals = {m: _by_unit(result, m, view, value) for m in result.methods if m not in NOT_RIVALS}
    with_rival = [unit for unit in ours if any(unit in found for found in rivals.values())]
    least = {unit: min((found[unit], m) for m, found in rivals.items() if unit in found) for unit in with_rival}
    return {unit: (ours[unit], name, error) for unit, (error, name) in sorted(least.items()) if error < ours[unit]}


def _not_first(result: Result, view: str) -> list[str]:
    """A sentence on the sequences on which some baseline is better, if there is one."""
    better, along = (better_baselines(result, view, value) for value in ("rmse_mm", "rmse_normal_mm"))
    if not (better or along):
        return []
    cases = [f"{unit} ({ours:.1f}; {TITLES.get(name, name)} {error:.1f})" for unit, (ours, name, error) in better.items()]
    which = f": {', '.join(cases)}" if cases else ""
    n = len(_by_unit(result, OURS, view, "rmse_mm"))
    return [f"{CONDITIONS[view].capitalize()}, some baseline has less RMSE on {len(better)} of {n} sequences{which}. "
            f"Along the normal it is {len(along)}."]  # fmt: skip


def _of(result: Result, view: str) -> list[dict]:
    return [cell for cell in result.cells if cell["view"] == view]


def _by_unit(result: Result, system: str, view: str, value: str) -> dict[str, float]:
    values = paired(_of(result, view), system, value)
    return by_unit(values, values)


def _least(means: dict, systems: Iterable[str], view: str, value: str) -> str | None:
    known = {m: means[m, view, value] for m in systems if means[m, view, value] is not None and m not in REFERENCES}
    return min(known, key=known.get) if known else None


def _partial(result: Result, system: str, view: str) -> bool:
    """Whether a system has a value on some of the view's sequences, but not on all on which any system has one."""
    having = {m: set(_by_unit(result, m, view, "rmse_mm")) for m in result.methods}
    return bool(having[system]) and having[system] != set().union(*having.values())


def _cell(mean: float | None, value: str, best: bool, partial: bool) -> Cell:
    if mean is None:
        return Cell("–", kind="none")
    return Cell(f"{mean:.{VALUES[value][1]}f}" + "*" * partial, kind="best" if best else "")


def _ratios(name: str, result: Result, views: list[str], value: str) -> list[Cell]:
    """A row with the ratio in the column of its value, and empty cells beside it."""
    row = [Cell(name)]
    for view in views:
        found = best_baseline(result, view, value)
        text = "–" if found is None else _text(*found)
        row += [Cell(text if column == value else "") for column in VALUES]
    return row


def _text(name: str, ratio: statistics.Ratio) -> str:
    interval = "" if ratio.low is None else f" [{ratio.low:.2f}, {ratio.high:.2f}]"
    return f"{ratio.mean:.2f}{interval}, {TITLES.get(name, name)}"

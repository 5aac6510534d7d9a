"""Tables of the report from results. The paper's numbers and the measured ones stand in separate columns."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ddakf.evaluation import metrics
from ddakf.evaluation.paper_scope import TITLES, ordered
from ddakf.evaluation.reporting import paper_numbers
from ddakf.evaluation.reporting.result_files import Pooled, Result
from ddakf.evaluation.splits import standing_of

HEADS = {
    "rmse_mm": "RMSE, mm", "rmse_normal_mm": "normal RMSE, mm", "rmse_tangential_mm": "tangential RMSE, mm",
    "hausdorff_mm": "Hausdorff, mm", "iou": "IoU",
    "stretch_percent": "stretch, %", "stretch_error_percent": "stretch against the truth, %", "bend_deg": "bend, deg",
    "bend_error_deg": "bend against the truth, deg", "penetration_mm": "penetration, mm",
    "penetration_violating_mm": "depth of what is inside, mm", "penetration_share": "share inside",
    "flicker": "flicker, mm/frame²",
    "acceleration_variance": "variance of acceleration, mm²/frame⁴", "ms_per_frame": "ms per frame", "fps": "frames per second",
    "memory_mib_per_frame": "MiB per frame", "recovery_frames": "frames to recover",
    "effective_sample_size": "effective sample size", "residual_mm": "points to surface, mm",
    "own_flicker": "own flicker, mm/frame²",
    "held_out_mm": "held-out depth, mm", "held_out_share": "held-out pixels within 30 mm",
    "silhouette_covered": "person covered", "silhouette_inside": "on the person",
    "limb_mm": "joints, mm", "moved_limb_mm": "moved joints, mm", "drift_mm": "drift after return, mm",
}  # fmt: skip
DECIMALS = {
    "iou": 3, "fps": 1, "penetration_mm": 2, "penetration_share": 4, "reliability": 2, "acceleration_variance": 2,
    "ms_per_frame": 0, "held_out_share": 2, "silhouette_covered": 2, "silhouette_inside": 2,
}  # fmt: skip
HIGHER_IS_BETTER = ("iou", "fps", "effective_sample_size", "held_out_share")
TRUTH = {  # the truth's own value of metrics that do not compare with it
    "stretch_percent": "stretch_truth_percent", "bend_deg": "bend_truth_deg", "penetration_mm": "penetration_truth_mm",
    "acceleration_variance": "acceleration_variance_truth",
}  # fmt: skip
# A frozen, a rigid, a torn or a shrunken garment would win these, or one that was already wrong. A high reliability alone is no
# merit.
UNRANKED = ("stretch_percent", "bend_deg", "acceleration_variance", "residual_mm", "own_flicker", "recovery_frames",
            "recovery_ratio", "reliability", "effective_sample_size", "held_out_mm", "silhouette_covered", "silhouette_inside",
            "drift_mm")  # fmt: skip
PARTIAL = "* the mean of fewer sequences x views: in the others the system does not apply, failed or has no such value."
WRONG, CONFIDENT = 100.0, 0.5  # mm of the joints; reliability
DEPTH_FRAMES = ("reliability", "limb_mm", "held_out_share")
RUNS = {"main": "undisturbed", "occlusion": "with an occlusion"}  # of Table 7
SIGN = (
    "Of a score that falls where the error grows the correlation is negative. The paper prints positive numbers and says that "
    "its score falls where the error grows: they are taken to be sizes."
)
SHORT = (
    "Cells: how much better DD-AKF is, effect size [95 % interval]. Verdict and Holm's p follow unless DD-AKF is better with "
    "p < 0.001."
)


@dataclass
class Cell:
    """A cell of a table: its text, its tooltip and its style."""

    text: str
    note: str = ""
    kind: str = ""  # "best", "paper", "none", "text"


@dataclass
class Table:
    """A table of the report.

    Attributes:
        name: of its anchor.
        title: above it.
        heads: of its columns.
        rows: of cells; the first one is the row's name.
        notes: below it.
        sources: results that its numbers come from.
    """

    name: str
    title: str
    heads: list[str]
    rows: list[list[Cell]]
    notes: list[str] = field(default_factory=list)
    sources: list[Result] = field(default_factory=list)


def comparison(name: str, title: str, result: Result, values: Iterable[str], paper: dict, view: str | None = None) -> Table:
    """Methods down, metrics across, each with the paper's number beside ours; the best of ours is set off.

    Args:
        name, title: of the table.
        result: of a study.
        values: names in a result's runs.
        paper: its printed numbers, by value and method.
        view: of the study; None: all.
    """
    values, methods = list(values), ordered(result.methods)

    def chosen(cell: dict) -> bool:
        return view is None or cell["view"] == view

    heads = ["system"]
    for value in values:
        heads += [HEADS[value], "in the paper"] if value in paper else [HEADS[value]]
    pools = {(m, v): result.pooled(m, v, chosen) for m in methods for v in values}
    best = {v: _best({m: pools[m, v] for m in methods if not result.mostly_lost(m, chosen)}, v) for v in values}
    rows = []
    for method in methods:
        row = [Cell(TITLES.get(method, method), result.reason(method))]
        for value in values:
            row.append(_cell(pools[method, value], value, result, method, best[value] == method))
            if value in paper:
                row.append(_paper(paper[value].get(method)))
        rows.append(row)
    if any(value in TRUTH and result.pooled(methods[0], TRUTH[value], chosen) for value in values):
        rows.append(_truth(result, values, paper, chosen))
    notes = _notes(rows, [result], methods)
    lost = {method: result.lost(method, chosen) for method in methods}
    if counts := [f"{TITLES.get(m, m)} {lost[m]} of {len(result.cells_of(m, chosen))}" for m in methods if lost[m]]:
        notes.append(f"Lost the garment, sequences x views: {'; '.join(counts)}.")
    for method in methods:
        if size := result.pooled(method, "effective_sample_size", chosen):
            notes.append(f"{TITLES.get(method, method)}: effective sample size {size.mean:.1f} particles in the mean.")
    return Table(name, title, heads, rows, notes, [result])


def _notes(rows: list[list[Cell]], results: Iterable[Result], methods: Iterable[str]) -> list[str]:
    """Why a system has no numbers, or fewer than others."""
    notes = [f"{TITLES.get(m, m)}: {r.reason(m)}" for r in results for m in methods if r.reason(m)]
    partial = any(cell.text.endswith("*") for row in rows for cell in row)
    return list(dict.fromkeys(notes)) + partial * [PARTIAL]


def _truth(result: Result, values: list[str], paper: dict, chosen: Callable[[dict], bool]) -> list[Cell]:
    """The truth's own row."""
    system, row = next(iter(result.methods)), [Cell("the truth itself")]
    for value in values:
        pool = result.pooled(system, TRUTH[value], chosen) if value in TRUTH else None
        row.append(_cell(pool, value, result, system, best=False))
        if value in paper:
            row.append(_paper(None))
    return row


def significance(name: str, title: str, result: Result, values: Iterable[str], paper: dict, view: str = "all") -> Table:
    """p-values of every system against DD-AKF, with Holm's correction, the effect and its interval, beside the paper's."""
    tests = result.p_values.get(view) or result.p_values.get("all", {})
    others = [m for m in ordered(result.methods) if m != "ddakf"]
    heads = ["metric", "system", "DD-AKF is better by", "p", "Holm", "effect [95 %]", "verdict"]
    heads += ["p in the paper"] if paper else []
    rows, notes = [], []
    for value in values:
        family = tests.get(value, {"comparisons": {}})
        for method in others:
            test = family["comparisons"].get(method)
            if test is None or test["n"] == 0:
                continue
            effect = "–"
            if test["effect"] is not None:
                effect = f"{test['effect']:+.2f} [{test['effect_low']:+.2f}, {test['effect_high']:+.2f}]"
            rows.append([
                Cell(HEADS[value]), Cell(TITLES.get(method, method)), Cell(_number(test["gain"], value)), Cell(p_text(test["p"])),
                Cell(p_text(test["p_holm"])), Cell(effect, f"{test['n']} sequences"), Cell(test["verdict_holm"]),
                *([Cell(paper.get(value, {}).get(method, "–"), kind="paper")] if paper else []),
            ])  # fmt: skip
            notes += [note for note in _test_notes(test) if note not in notes]
        if (standing := family.get("standing")) and value not in UNRANKED:
            notes.append(_standing(HEADS[value], standing))
    return Table(name, title, heads, rows, notes, [result])


def effects(name: str, title: str, result: Result, values: Iterable[str]) -> Table:
    """The tests over all views in short, metrics down and systems across: gain, effect, Holm's p from 0.001 on."""
    methods, families = [m for m in ordered(result.methods) if m != "ddakf"], result.p_values.get("all", {})
    tests = {v: families.get(v, {}).get("comparisons", {}) for v in values}
    tests = {v: {m: test for m, test in tests[v].items() if test["n"]} for v in tests}
    rows = [[Cell(HEADS[v]), *(_effect(tests[v].get(m), v) for m in methods)] for v in tests if tests[v]]
    notes = dict.fromkeys(note for v in tests for test in tests[v].values() for note in _test_notes(test))
    lost = {m: None for v in tests for m in families.get(v, {}).get("standing", {}).get("lost", ()) if v not in UNRANKED}
    if lost:
        notes[f"Lost the garment: {', '.join(TITLES.get(m, m) for m in ordered(lost))}."] = None
    return Table(name, title, ["metric", *(TITLES.get(m, m) for m in methods)], rows, [SHORT, *notes], [result])


def _effect(test: dict | None, value: str) -> Cell:
    """A test as gain, effect [interval], and verdict and p unless DD-AKF is better by p < 0.001."""
    if test is None:
        return Cell("–")
    text = _number(test["gain"], value)
    if test["effect"] is not None:
        text += f", {test['effect']:+.2f} [{test['effect_low']:+.2f}, {test['effect_high']:+.2f}]"
    usual = test["verdict_holm"] == "better" and test["p_holm"] < 0.001
    return Cell(text if usual else f"{text}, {test['verdict_holm']}, p {p_text(test['p_holm'])}")


def _test_notes(test: dict) -> list[str]:
    """Number of sequences and smallest p of a test."""
    statement = (
        f"{test['n']} sequences (FAUST: subjects), signs flipped by sequence, intervals by a bootstrap over sequences; the "
        f"smallest p that can be had: {test['p_smallest']:.2g}. An interval that holds 0 is never called better."
    )
    return [statement]


def _standing(metric: str, standing: dict) -> str:
    """A sentence on the baselines that DD-AKF beats, of those that use the cloud and were not lost."""

    def names(methods: list[str]) -> str:
        return ", ".join(TITLES.get(method, method) for method in methods)

    beaten, rivals = standing["better"], standing["rivals"]
    text = f"{metric}: in the mean better than {len(beaten)} of the {len(rivals)} systems that use the cloud and were not lost"
    if standing["significantly"]:
        text += f", significantly than {names(standing['significantly'])}"
    if others := [method for method in rivals if method not in beaten]:
        text += f"; not than {names(others)}"
    if standing["lost"]:
        text += f". Lost: {names(standing['lost'])}"
    return text + "."


def sweep(
    name: str, title: str, results: dict[int, Result], value: str, paper: dict[int, dict[str, str]], unit: str
) -> Table:
    """Levels of a degradation down, systems across.

    Args:
        name, title: of the table.
        results: by level.
        value: shown.
        paper: its printed numbers, by level and method.
        unit: of a level.
    """
    methods = ordered(dict.fromkeys(m for result in results.values() for m in result.methods))
    heads = [unit]
    for method in methods:
        heads += [TITLES.get(method, method), *(["in the paper"] if _printed(method, paper) else [])]
    rows = []
    for level, result in sorted(results.items()):
        pools = {m: result.pooled(m, value) for m in methods}
        best, row = _best({m: pool for m, pool in pools.items() if not result.mostly_lost(m)}, value), [Cell(str(level))]
        for method in methods:
            row.append(_cell(pools[method], value, result, method, best == method))
            if _printed(method, paper):
                row.append(_paper(paper.get(level, {}).get(method)))
        rows.append(row)
    return Table(name, title, heads, rows, _notes(rows, results.values(), methods), list(results.values()))


def _printed(method: str, paper: dict) -> bool:
    return bool(paper) and method in paper_numbers.METHODS


def by_sequence(
    name: str, title: str, result: Result, value: str, *, group: Callable[[str], str] = str, head: str = "sequence",
    systems: Iterable[str] | None = None,
) -> Table:
    """Sequences (or groups of them) and views down, systems (those of the study, or some of them) across."""
    methods = [m for m in ordered(result.methods) if systems is None or m in systems]
    places = dict.fromkeys((group(cell["sequence"]), cell["view"]) for cell in result.cells)
    rows = []
    for sequence, view in places:
        def chosen(cell: dict, sequence=sequence, view=view) -> bool:
            return (group(cell["sequence"]), cell["view"]) == (sequence, view)

        pools = {m: result.pooled(m, value, chosen) for m in methods}
        best = _best({m: pool for m, pool in pools.items() if not result.mostly_lost(m, chosen)}, value)
        rows.append([Cell(Path(sequence).name), Cell(view), *(_cell(pools[m], value, result, m, best == m) for m in methods)])
    if group is str:  # sequences: each with its standing
        for row, (sequence, _) in zip(rows, places, strict=True):
            row.insert(2, Cell(standing_of(Path(sequence).name)))
    heads = [head, "view", *(["constants"] if group is str else []), *(TITLES.get(m, m) for m in methods)]
    return Table(name, title, heads, rows, _notes(rows, [result], methods), [result])


def behind(name: str, title: str, result: Result, values: Iterable[str]) -> Table:
    """Cases in which another system beats DD-AKF: sequence and view down, metrics across; both means in each cell."""
    values, places = list(values), list(dict.fromkeys((cell["sequence"], cell["view"]) for cell in result.cells))
    found = {(place, value): _ahead(result, place, value) for place in places for value in values}
    heads = [value for value in values if any(found[place, value] for place in places)]
    rows = [
        [Cell(Path(place[0]).name), Cell(place[1]), Cell(standing_of(Path(place[0]).name)),
         *(Cell(found[place, value] or "–") for value in heads)]
        for place in places if any(found[place, value] for value in values)
    ]  # fmt: skip
    notes = [f"Cells: the best system, its mean, DD-AKF's mean. {len(values)} metrics, {len(places)} pairs of sequence and view; "
             "DD-AKF is best in all others."]  # fmt: skip
    if failed := [f"{Path(name).name} {view}" for name, view in places if not _ours(result, (name, view))]:
        notes.append(f"DD-AKF has no result of {', '.join(failed)}: {result.reason('ddakf')}.")
    return Table(name, title, ["sequence", "view", "constants", *(HEADS[value] for value in heads)], rows, notes, [result])


def _ahead(result: Result, place: tuple[str, str], value: str) -> str | None:
    """The system with the best mean of a sequence in a view, its mean and DD-AKF's; None where DD-AKF's is best."""
    means = {
        cell["method"]: cell["mean"][value]
        for cell in result.cells
        if (cell["sequence"], cell["view"]) == place and cell["mean"] and cell["mean"][value] is not None
    }
    best = _first(means, value)
    if best is None or means[best] == means.get("ddakf") or ("ddakf" not in means and _ours(result, place)):
        return None
    ours = _number(means["ddakf"], value) if "ddakf" in means else "none"
    return f"{TITLES.get(best, best)}: {_number(means[best], value)}, {ours}"


def _ours(result: Result, place: tuple[str, str]) -> bool:
    """Whether DD-AKF has a result of a sequence in a view."""
    return any(cell["mean"] for cell in result.cells_of("ddakf", lambda c: (c["sequence"], c["view"]) == place))


def reliability(name: str, title: str, results: list[Result]) -> Table:
    """Rank correlations of the two scores of DD-AKF with its error and its penetration: mean over runs, within each."""
    rows = []
    for label, system, score in (
        ("reliability", "ddakf", "reliability"),
        ("s_k of the default", "ddakf", "paper_score"),
        ("s_k as printed", "paper", "paper_score"),
    ):
        row = [Cell(label)]
        for error in ("rmse", "penetration"):
            for result in results:
                row.append(_cell(result.pooled(system, f"spearman_{score}_{error}"), "spearman", result, system, False))
            row.append(Cell(str(paper_numbers.RELIABILITY[error]), "as the paper prints it", "paper"))
        rows.append(row)
    heads = ["score"]
    for error in ("RMSE", "penetration"):
        heads += [f"{error}, {RUNS.get(result.name, result.name)}" for result in results] + ["in the paper"]
    return Table(name, title, heads, rows, [SIGN], results)


def depth_reliability(name: str, title: str, result: Result) -> Table:
    """DD-AKF's reliability on real depth against what can be measured there, a row per recording: means over frames and runs."""
    heads = ["sequence", "reliability", "frames tracking", "rank correlation with the joints' error", "with the held-out share",
             f"frames with joints {WRONG:g} mm off", f"of them over {CONFIDENT:g}"]  # fmt: skip
    rows = []
    for cell in result.cells_of("ddakf", lambda cell: bool(cell["runs"])):
        frames = {key: [v for run in cell["runs"] for v in run["per_frame"].get(key, [])] for key in DEPTH_FRAMES}
        score, held_out = np.array(frames["reliability"]), np.array(frames["held_out_share"], float)
        error = np.array(frames["limb_mm"], float)  # None is NaN
        wrong = error > WRONG
        tracking = sum(run["states"].get("tracking", 0) for run in cell["runs"])
        row = [Path(cell["sequence"]).name, f"{score.mean():.2f}", f"{tracking / len(score):.0%}"]
        for other in (error, held_out):
            known = np.isfinite(other) if len(other) else np.zeros(len(score), bool)
            row.append(f"{metrics.spearman(score[known], other[known]):.2f}" if known.any() else "–")
        row += [f"{wrong.mean():.0%}" if len(wrong) else "–", f"{(score[wrong] > CONFIDENT).mean():.0%}" if wrong.any() else "–"]
        rows.append([Cell(text) for text in row])
    return Table(name, title, heads, rows, [], [result])


def p_text(p: float | None) -> str:
    return "–" if p is None else "< 0.001" if p < 0.001 else f"{p:.3f}"


def _best(pools: dict[str, Pooled | None], value: str) -> str | None:
    """The method with the best mean, of those that apply everywhere; None where less is not better."""
    if value in UNRANKED:
        return None
    complete = {method: pool for method, pool in pools.items() if pool is not None and pool.cells == pool.cells_in_all}
    return _first({method: pool.mean for method, pool in complete.items()}, value)


def _first(means: dict[str, float], value: str) -> str | None:
    """The method with the best mean."""
    pick = max if value in HIGHER_IS_BETTER else min
    return pick(means, key=means.get) if means else None


def _cell(pool: Pooled | None, value: str, result: Result, method: str, best: bool) -> Cell:
    if pool is None:
        return Cell("–", result.reason(method), "none")
    text = _number(pool.mean, value) + ("" if pool.sd is None else f" ± {_number(pool.sd, value)}")
    if pool.cells < pool.cells_in_all:
        text += "*"
    note = f"{result.name}.json: {pool.runs} runs, mean of {pool.cells} of {pool.cells_in_all} sequences x views"
    return Cell(text, note, "best" if best else "")


def _paper(text: str | None) -> Cell:
    return Cell(text or "–", "as the paper prints it", "paper")


def _number(number: float, value: str) -> str:
    return f"{number:.{DECIMALS.get(value, 2 if value.startswith('spearman') else 1)}f}"

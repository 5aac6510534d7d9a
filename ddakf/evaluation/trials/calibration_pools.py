"""Calibration pools: claimed covariances of many runs against the truth, pooled by group of vertices."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable

import numpy as np

from ddakf.evaluation import metrics
from ddakf.evaluation.metrics.calibration import NOMINAL_PROBABILITIES

GROUPS = ("observed", "hidden, body given", "hidden, no body")

def view_of(row: dict) -> str:
    """``front+body``, for instance."""
    return row["view"] + ("+body" if row["body"] else "") + ("" if row["segmented"] else ", unsegmented")


def mean(rows: list[dict], key: str) -> float | None:
    """Mean over the rows that have a value; None without any."""
    values = [row[key] for row in rows if row.get(key) is not None]
    return float(np.mean(values)) if values else None


def by_kind(rows: list[dict]) -> tuple[list[dict], list[dict], list[dict]]:
    """The rows of the grid, of displaced starts, and of disturbed runs."""
    grid, starts, disturbed = [], [], []
    for row in rows:
        (starts if row["start"] is not None else disturbed if row["disturbance"] is not None else grid).append(row)
    return grid, starts, disturbed


def calibrated(rows: list[dict], variant: str = "default") -> list[dict]:
    """Claimed covariances pooled over runs with a mask: all, each view, and each sequence where there are several.

    Args:
        rows: of trials.
        variant: of the method.

    Returns:
        By part of the runs and by group: ``runs``, ``group``, ``n``, ``coverage90``, ``nees3``, ``nll_excess`` over the best
        constant covariance's, and ``spearman_front``: mean rank correlation of sigma and error within frames, single view.
    """
    rows = with_mask(rows, variant)
    names = sorted({row["sequence"] for row in rows})
    parts: list[tuple[str, Callable[[dict], bool]]] = [("all", lambda row: True)]
    parts += [(view, lambda row, view=view: view_of(row) == view) for view in dict.fromkeys(map(view_of, rows))]
    parts += [(name, lambda row, name=name: row["sequence"] == name) for name in names if len(names) > 1]
    pools = []
    for name, belongs in parts:
        chosen = [row for row in rows if belongs(row)]
        single = [row for row in chosen if row["view"] == "front"]
        spearman = mean(single, "spearman_sigma") if single else None
        for group, pool in pooled(chosen).items():
            pools.append({
                "runs": name, "group": group, "n": pool["n"], "coverage90": pool["coverage90"], "nees3": pool["nees3"],
                "nll_excess": pool["nll"] - pool["nll_constant"], "spearman_front": spearman,
            })  # fmt: skip
    return pools


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
    rows: Iterable[dict], variant: str = "default"
) -> dict[str, tuple[tuple[float, ...], list[float]]]:
    """Nominal probabilities and observed shares by group, for the reliability diagram."""
    pools = pooled(with_mask(by_kind(list(rows))[0], variant))
    return {group: (NOMINAL_PROBABILITIES, pool["inside"]) for group, pool in pools.items()}


def with_mask(rows: list[dict], variant: str) -> list[dict]:
    return [row for row in rows if row["variant"] == variant and row["segmented"] and "failed" not in row]

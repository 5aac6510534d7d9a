"""Calibration pools: claimed covariances of many runs against the truth, pooled by group of vertices."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from scipy.stats import chi2

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


def calibrated(rows: list[dict], variant: str = "default", scale: Mapping[str, float] | None = None) -> list[dict]:
    """Claimed covariances pooled over runs with a mask: all, each half of the sequences, each view and each sequence.

    Args:
        rows: of trials.
        variant: of the method.
        scale: by group, factor on the claimed standard deviations, see :func:`rescaled`; 1 by default.

    Returns:
        By part of the runs and by group: ``runs``, ``group``, ``n``, ``coverage90``, ``nees3``, ``nll_excess`` over the best
        constant covariance's, and ``spearman_front``: mean rank correlation of sigma and error within frames, single view.
    """
    rows = with_mask(rows, variant)
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
    """A pool of :func:`pooled` for ``scale`` times the claimed standard deviations.

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
    pools = pooled(with_mask(by_kind(list(rows))[0], variant))
    pools = {group: rescaled(pool, (scale or {}).get(group, 1.0)) for group, pool in pools.items()}
    return {group: (NOMINAL_PROBABILITIES, pool["inside"]) for group, pool in pools.items()}


def with_mask(rows: list[dict], variant: str) -> list[dict]:
    return [row for row in rows if row["variant"] == variant and row["segmented"] and "failed" not in row]

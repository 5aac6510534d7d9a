"""Laws of the error's size along and across the normal: ``python benchmarks/error_size.py [--fit] [--procs 2] [--frames 120]``.

Tracks the recordings of the collection, and the captures of DDAKF_DATA, in five views, and in three of them with a slow, a
sparse and a noisy sensor. Prints by garment and by sensor, for each group of vertices, the share of the vertices in their 90 %
ellipsoids, NEES/3, and the NEES along the normal and across it, each over its directions. Then, by view, over all sensors and
for the undisturbed one, the rank correlation of sigma and error within a frame, and that of reliability and error; the RMSE
of the frames by what their reliability says; and errors and claims in the course of a run: with ``--frames 960`` of 32 s.
Training recordings, captures and held-out recordings, on which nothing is chosen, stand apart.
Draws the shares in the ellipsoids of all levels.

``--fit`` fits the powers and bases of ``NormalError`` and ``TangentialError`` to the training recordings (maximum likelihood of a
Student t with 20 degrees of freedom, every run the same weight; then the bases of each group, so that the 90 % ellipsoids hold
92 % in the mean of the undisturbed runs: a margin for garments that were not there; then, across the normal, so that those of the
undisturbed captures hold 90 %: real cloth, finer than any mesh, slides more along its surface than simulated cloth) and prints
them, with the same tables for the fitted laws, each garment by laws that were fitted without it.
Of ``--preset fast`` only the bases are fitted.
Likelihoods are compared with those of one size for each group. ``FrameError`` is fitted to the sigmas as reported: in a second
run, when the other laws are in the configuration.
"""

from __future__ import annotations

import argparse
import json
import sys
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from committed import parsed
from error_runs import CAPTURED, GROUPS, PRESETS, Frames, Rows, Run, load, planned, play, save
from scipy.optimize import brentq, minimize
from scipy.stats import chi2

from ddakf.evaluation import machine, metrics
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.drawing import diagrams
from ddakf.stages.error_size import USUAL, SizeEvidence

BASES = ("seen", "on_body", "hidden")
LEVELS = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99])
INSIDE = float(chi2.ppf(0.9, 3))  # squared Mahalanobis distance of the 90 % ellipsoid
DEGREES = 20.0  # of freedom: errors have heavier tails, but laws of such tails pass over the failures that they should tell
WITHIN = 0.92  # share that the 90 % ellipsoids hold in the mean of the undisturbed runs that are fitted
CAPTURED_WITHIN = 0.90  # the same of the captures
WIDEST = 5.0  # logarithm of the widening for them, at most
RIDGE = 1e-3  # on the powers: one that says nothing is zero
FAILED = 0.05  # m, RMSE of a frame that has failed
BETTER = 0.85  # share of the fitted frames that have less error than is predicted
TIMES = (0, 1, 2, 4, 8, 16, 32)  # s since the start
BANDS = (0.0, 0.31, 0.5, 0.64, 0.8, 0.94, 1.0)  # of the reliability
LEAST_OF_RUN = 100  # vertices of a group in the frames of a capture, for it to count
LEAST_VERTICES = 10  # of a group in a frame, for a rank correlation
DIAGRAM = Path(__file__).resolve().parents[1] / "out/error_size.png"


# Fit ----------------------------------------------------------------------------------------------------------------


class Fit(NamedTuple):
    """Both laws: logarithms of the bases (2, 3), powers (2, 1 + fields) of the claimed size and of the evidence."""

    bases: np.ndarray
    powers: np.ndarray

    def log_sizes(self, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
        """(N,) each, of metres: along the normal and across it."""
        return tuple(self.bases[d][rows.group] + _columns(rows, d) @ self.powers[d] for d in range(2))

    def distances(self, rows: Rows) -> np.ndarray:
        """(N, 3) squared Mahalanobis distances: whole, along the normal, across it."""
        along, across = self.log_sizes(rows)
        parts = rows.along2 * np.exp(-2 * along), rows.across2 * np.exp(-2 * across)
        return np.column_stack([sum(parts), *parts])


def _columns(rows: Rows, direction: int) -> np.ndarray:
    return np.column_stack([rows.evidence[:, direction], rows.evidence[:, 2:]])


def fitted(rows: Rows, captured: Rows | None, usual: np.ndarray, powers: np.ndarray | None = None) -> Fit:
    """The laws that suit the rows best, wide enough for the ``usual`` runs (bool), and for those of captures.

    With these ``powers``, or None: with powers that are fitted as well.
    """
    weight = _weights(rows)
    columns, member = [_columns(rows, d) for d in range(2)], np.eye(3)[rows.group]
    n = columns[0].shape[1]
    half = (DEGREES + 3) / 2

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        fit = Fit(values[:6].reshape(2, 3), values[6:].reshape(2, n) if powers is None else powers)
        along, across = fit.log_sizes(rows)
        first, second = rows.along2 * np.exp(-2 * along), rows.across2 * np.exp(-2 * across)
        tail = 1.0 + (first + second) / DEGREES
        value = weight @ (along + 2 * across + half * np.log(tail)) + RIDGE * fit.powers.sum()
        slopes = weight * (1 - 2 * half * first / DEGREES / tail), weight * (2 - 2 * half * second / DEGREES / tail)
        by_base = [slope @ member for slope in slopes]
        by_power = [] if powers is not None else [s @ c + RIDGE for s, c in zip(slopes, columns, strict=True)]
        return float(value), np.concatenate([*by_base, *by_power])

    free = 2 * n if powers is None else 0
    start = np.concatenate([np.full(6, np.log(USUAL) - 1.0), np.full(free, 0.1)])
    bounds = [(None, None)] * 6 + [(0.0, None)] * free
    best = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 2000}).x
    fit = Fit(best[:6].reshape(2, 3), best[6:].reshape(2, n) if powers is None else powers)
    fit = fit._replace(bases=fit.bases + _widening(fit.distances(rows)[:, 0], rows, usual))
    return fit if captured is None else _widened(fit, captured, usual)


def _widened(fit: Fit, captured: Rows, usual: np.ndarray) -> Fit:
    """The laws with wider bases where too few vertices of a group of the captures are in their ellipsoids.

    Across the normal, and where no width there is enough, in both directions.
    """
    _, along, across = fit.distances(captured).T
    bases = fit.bases.copy()
    for group in range(len(GROUPS)):
        chosen = (captured.group == group) & usual[captured.run]
        runs = [chosen & (captured.run == run) for run in np.unique(captured.run[chosen])]
        runs = [run for run in runs if np.count_nonzero(run) >= LEAST_OF_RUN]

        def lack(wider: float, fixed: np.ndarray, free: np.ndarray, runs: list[np.ndarray] = runs) -> float:
            inside = fixed + free * np.exp(-2 * wider) < INSIDE
            return float(np.mean([inside[run].mean() for run in runs])) - CAPTURED_WITHIN

        if not runs or lack(0.0, along, across) >= 0.0:
            continue
        if lack(WIDEST, along, across) > 0.0:
            bases[1, group] += brentq(lack, 0.0, WIDEST, (along, across))
        else:
            bases[:, group] += brentq(lack, 0.0, WIDEST, (np.zeros_like(along), along + across))
    return fit._replace(bases=bases)


def _weights(rows: Rows) -> np.ndarray:
    """(N,) the same for each run and group."""
    place = rows.run * len(GROUPS) + rows.group
    count = np.bincount(place)
    return 1.0 / count[place] / np.count_nonzero(count)


def _widening(distance: np.ndarray, rows: Rows, usual: np.ndarray) -> np.ndarray:
    """(3,) by group, to add to the logarithm of the sizes: then ``WITHIN`` are inside in the mean of the usual runs."""
    wide, judged = np.zeros(len(GROUPS)), usual[rows.run]
    for group in np.unique(rows.group[judged]):
        chosen = judged & (rows.group == group)
        runs = [distance[chosen & (rows.run == r)] for r in np.unique(rows.run[chosen])]
        wide[group] = brentq(lambda s, runs=runs: np.mean([(d < INSIDE * np.exp(2 * s)).mean() for d in runs]) - WITHIN, -5, 5)
    return wide


def fitted_frames(frames: Frames) -> dict[str, float]:
    """The law of the frames' error: the share of the claimed RMS error so that ``BETTER`` have less error, every run alike.

    The power by which unexplained points widen all sigmas stays: hardly any frame of the collection shows cloth that is not the
    garment's.
    """
    weight = 1.0 / np.bincount(frames.run)[frames.run]
    share = np.quantile(frames.rmse / frames.sigma, BETTER, weights=weight, method="inverted_cdf")
    return {"sigma_share": round(float(share), 3)}


# Report -------------------------------------------------------------------------------------------------------------


def table(title: str, distances: np.ndarray, rows: Rows, runs: list[Run]) -> list[dict]:
    """Prints and returns coverage and NEES by group, over all runs, by sensor and by garment."""
    print(f"\n{title}: in 90 % ellipsoids, NEES/3, along the normal, across it /2")
    print(f"{'':16s}" + "".join(f"{name:>28s}" for name in GROUPS))
    garment, condition = (np.array(each) for each in zip(*((r.listed.garment, r.condition) for r in runs), strict=True))
    garment, condition = garment[rows.run], condition[rows.run]
    parts = {"all": np.ones(len(rows.run), bool), "undisturbed": condition == ""}
    parts |= {name: condition == name for name in sorted(set(condition) - {""})}
    parts |= {name: garment == name for name in sorted(set(garment))}
    found = []
    for name, of_part in parts.items():
        cells = []
        for group in range(len(GROUPS)):
            chosen = distances[of_part & (rows.group == group)]
            if len(chosen):
                cell = {"coverage90": (chosen[:, 0] < INSIDE).mean(), "nees3": chosen[:, 0].mean() / 3}
                cell |= {"normal_nees": chosen[:, 1].mean(), "tangential_nees2": chosen[:, 2].mean() / 2}
                rounded = {key: round(float(value), 3) for key, value in cell.items()}
                found.append({"part": name, "group": GROUPS[group]} | rounded)
                share, *nees = cell.values()
                cells.append(f"{share:9.0%}" + "".join(f"{value:6.2f}" for value in nees) + " ")
            else:
                cells.append(" " * 28)
        print(f"{name:16s}" + "".join(cells))
    return found


def curves(distances: np.ndarray, rows: Rows) -> dict[str, tuple[list, list]]:
    """By group: levels, and the shares of the vertices in the ellipsoids of these levels."""
    bounds = chi2.ppf(LEVELS, 3)
    shares = {
        name: (distances[rows.group == group, 0][:, None] < bounds).mean(axis=0)
        for group, name in enumerate(GROUPS)
        if (rows.group == group).any()
    }
    return {name: (LEVELS.tolist(), share.round(3).tolist()) for name, share in shares.items()}


def rankings(title: str, rows: Rows, frames: Frames, runs: list[Run]) -> list[dict]:
    """Prints and returns by view: Spearman of sigma and error within frames, and how well reliability tells errors of frames."""
    print(f"\n{title}: sigma against error in a frame; reliability against RMSE: rho, ROC area, >= 0.9 and > 0.5 above 50 mm")
    view, usual = np.array([run.view for run in runs]), _undisturbed(runs)
    parts = {"all": np.ones(len(runs), bool)}
    for name in dict.fromkeys(view):
        parts |= {name: view == name, f"{name}, undisturbed": (view == name) & usual}
    inside, found = _within_frames(rows), []
    for name, part in parts.items():
        chosen = part[frames.run]
        rmse, score, failed = frames.rmse[chosen], frames.reliability[chosen], frames.rmse[chosen] > FAILED
        rho = [value for run, values in inside.items() if part[run] for value in values]
        row = {"view": name, "sigma": np.nanmean(rho), "rho": metrics.spearman(score, rmse), "frames": len(rmse)}
        row |= {"failed": int(failed.sum()), "roc": metrics.roc_auc(-score, failed)}
        row |= {f"{word} while failed": (above & failed).sum() / max(failed.sum(), 1) for word, above in _sure(score).items()}
        found.append({key: value if isinstance(value, str | int) else _rounded(value) for key, value in row.items()})
        print("  ".join(f"{key} {value}" for key, value in found[-1].items()))
    return found


def said(title: str, frames: Frames, half_error: float) -> list[dict]:
    """Prints and returns by band of the reliability: RMSE of the frames, and the share that is below what each says."""
    print(f"\n{title}: RMSE of frames by reliability")
    expected, found = half_error * np.sqrt(1.0 / frames.reliability - 1.0), []
    for low, high in pairwise(BANDS):
        chosen = (frames.reliability >= low) & (frames.reliability < high)
        if chosen.any():
            rmse, bound = frames.rmse[chosen], expected[chosen]
            row = {"from": low, "to": high, "frames": int(chosen.sum()), "said_mm": 1e3 * np.median(bound)}
            row |= {"median_mm": 1e3 * np.median(rmse), "p90_mm": 1e3 * np.quantile(rmse, 0.9), "below": (rmse < bound).mean()}
            found.append({key: value if key in ("from", "to", "frames") else _rounded(value) for key, value in row.items()})
            print("  ".join(f"{key} {value}" for key, value in found[-1].items()))
    return found


def course(title: str, frames: Frames, runs: list[Run]) -> list[dict]:
    """Prints and returns by view and time since the start, of the undisturbed runs: geometric means of RMSE and claimed RMSE."""
    print(f"\n{title}: RMSE and claimed RMSE in the course of undisturbed runs, mm")
    view, usual, found = np.array([run.view for run in runs]), _undisturbed(runs), []
    seconds, last = frames.frame / 30.0, frames.frame.max() / 30.0
    for name in dict.fromkeys(view):
        of_view = ((view == name) & usual)[frames.run]
        for low, high in pairwise(edge for edge in TIMES if edge < 2 * last):
            chosen = of_view & (seconds > low) & (seconds <= high)
            mean = [1e3 * np.exp(np.log(values[chosen]).mean()) for values in (frames.rmse, frames.sigma)]
            times, sizes = {"from_s": low, "to_s": high}, {"rmse_mm": mean[0], "claimed_mm": mean[1]}
            found.append({"view": name} | times | {key: _rounded(value) for key, value in sizes.items()})
            print("  ".join(f"{key} {value}" for key, value in found[-1].items()))
    return found


def _undisturbed(runs: list[Run]) -> np.ndarray:
    return np.array([run.condition == "" for run in runs])


def _rounded(value: float) -> float | None:
    return round(float(value), 3) if np.isfinite(value) else None


def _sure(score: np.ndarray) -> dict[str, np.ndarray]:
    return {"at least 0.9": score >= 0.9, "over 0.5": score > 0.5}


def _within_frames(rows: Rows) -> dict[int, list[float]]:
    """By run: Spearman of sigma and error over the vertices of each frame."""
    found: dict[int, list[float]] = {}
    key = rows.run * 10_000 + rows.frame
    edges = np.flatnonzero(np.diff(key)) + 1
    for part in np.split(np.arange(len(key)), edges):
        if len(part) >= LEAST_VERTICES:
            found.setdefault(int(rows.run[part[0]]), []).append(metrics.spearman(rows.sigma[part], rows.error[part]))
    return found


def likelihood(fit: Fit, rows: Rows) -> np.ndarray:
    """(N,) logarithms of the density of the errors, up to a constant."""
    along, across = fit.log_sizes(rows)
    return -(along + 2.0 * across + 0.5 * (DEGREES + 3.0) * np.log1p(fit.distances(rows)[:, 0] / DEGREES))


def present(preset: str) -> Fit:
    """The laws of a preset."""
    config = PRESETS[preset]()
    laws, fields = (config.normal_error, config.tangential_error), ["claimed", *SizeEvidence._fields]
    bases = np.log([[getattr(law, base) for base in BASES] for law in laws])
    return Fit(bases, np.array([[getattr(law, f"{field}_power") for field in fields] for law in laws]))


def report(
    runs: list[Run], rows: Rows, frames: Frames, fit: bool, preset: str = "default", keep_powers: bool = False
) -> dict:
    """Prints the tables of all splits; with ``fit``, those of fitted laws and the laws. Only the default's powers are fitted."""
    found = {"machine": machine.describe(), "commit": machine.commit(), "preset": preset}
    found |= {"tables": {}, "levels": {}, "rankings": {}, "said": {}, "course": {}}
    split = np.array([run.listed.split for run in runs])
    splits = [name for name in (collection.TRAINING, CAPTURED, collection.HELD_OUT) if name in split]
    of = {name: Rows(*(column[split[rows.run] == name] for column in rows)) for name in splits}
    for name, part in of.items():
        of_frames = Frames(*(column[split[frames.run] == name] for column in frames))
        found["tables"][name] = table(f"{name}, as reported", part.reported, part, runs)
        found["levels"][name] = curves(part.reported, part)
        found["rankings"][name] = rankings(name, part, of_frames, runs)
        found["course"][name] = course(name, of_frames, runs)
        found["said"][name] = said(name, of_frames, PRESETS[preset]().reliability.half_error)
        today = present(preset).distances(part)  # other numbers than those reported where --rows are older than the laws
        found["tables"][f"{name}, present laws"] = table(f"{name}, by the present laws", today, part, runs)
        found["levels"][f"{name}, present laws"] = curves(today, part)
    if fit:
        training = of[collection.TRAINING]
        powers, usual = present(preset).powers if keep_powers or preset != "default" else None, _undisturbed(runs)
        captured = of.get(CAPTURED)
        laws = fitted(training, captured, usual, powers)
        others, gained = left_out(training, captured, runs, powers)
        found["log_likelihood_gained"] = gained
        found["tables"]["each garment left out"] = table("fitted, each garment left out", others, training, runs)
        found["levels"]["each garment left out"] = curves(others, training)
        if captured is not None:
            found["tables"]["captured, fitted"] = table("captured, fitted", laws.distances(captured), captured, runs)
        if collection.HELD_OUT in of:
            fresh = of[collection.HELD_OUT]
            found["tables"]["held-out, fitted"] = table("held-out, fitted", laws.distances(fresh), fresh, runs)
            found["levels"]["held-out, fitted"] = curves(laws.distances(fresh), fresh)
        chosen = split[frames.run] != collection.HELD_OUT
        found["laws"] = written(laws) | {"FrameError": fitted_frames(Frames(*(column[chosen] for column in frames)))}
        print("FrameError", found["laws"]["FrameError"])
    return found


def left_out(
    rows: Rows, captured: Rows | None, runs: list[Run], powers: np.ndarray | None
) -> tuple[np.ndarray, dict[str, float]]:
    """(N, 3) distances of each garment's rows by laws that were fitted without it.

    And by group the mean gain in log-likelihood over one size for each group, likewise fitted without it; printed.
    """
    garments, usual = np.array([run.listed.garment for run in runs]), _undisturbed(runs)
    garment, found, gained = garments[rows.run], np.empty((len(rows.run), 3)), np.empty(len(rows.run))
    for name in sorted(set(garment)):
        mine, rest = (Rows(*(column[chosen] for column in rows)) for chosen in (garment == name, garment != name))
        simple = np.zeros((2, 1 + len(SizeEvidence._fields)))
        laws, plain = (fitted(rest, captured, usual, each) for each in (powers, simple))
        found[garment == name] = laws.distances(mine)
        gained[garment == name] = likelihood(laws, mine) - likelihood(plain, mine)
    weight = _weights(rows)
    means = {name: np.average(gained[rows.group == g], weights=weight[rows.group == g]) for g, name in enumerate(GROUPS)}
    means = {name: round(float(value), 3) for name, value in means.items()}
    print(f"log-likelihood over that of one size for each group, garments left out: {means}")
    return found, means


def written(fit: Fit) -> dict[str, dict[str, float]]:
    """The laws by class and field; prints them."""
    laws = {}
    for name, bases, powers in zip(("NormalError", "TangentialError"), fit.bases, fit.powers, strict=True):
        laws[name] = {base: round(float(np.exp(value)), 5) for base, value in zip(BASES, bases, strict=True)}
        fields = ["claimed", *SizeEvidence._fields]
        laws[name] |= {f"{field}_power": round(float(value), 3) for field, value in zip(fields, powers, strict=True)}
        print(name, laws[name])
    return laws


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fit", action="store_true", help="fit the laws to the training recordings")
    parser.add_argument("--keep-powers", action="store_true", help="with --fit: the bases alone")
    parser.add_argument("--preset", choices=PRESETS, default="default")
    parser.add_argument("--frames", type=int, default=120, help="of a run, which plays to and fro (default 120)")
    parser.add_argument("--procs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--recordings", nargs="+", metavar="NAME", help="default: the collection, captures")
    parser.add_argument("--rows", type=Path, metavar="FILE", help=".npz of the runs: read if it is there, else written")
    parser.add_argument("--json", type=Path, metavar="FILE", help="of the tables and the laws")
    parser.add_argument("--diagram", type=Path, default=DIAGRAM, help="picture of the levels (default out/error_size.png)")
    arguments = parsed(parser, argv, target="json")
    runs, settings = planned(arguments.recordings), f"{arguments.preset}, {arguments.frames} frames"
    if arguments.fit and not any(run.listed.split == collection.TRAINING for run in runs):
        parser.error("--fit: expected training recordings among --recordings, got none")
    if arguments.rows and arguments.rows.is_file():
        rows, frames = load(arguments.rows, runs, settings)
    else:
        rows, frames = play(runs, arguments.frames, arguments.procs, arguments.preset)
        if arguments.rows:
            save(arguments.rows, runs, rows, frames, settings)
    found = report(runs, rows, frames, arguments.fit, arguments.preset, arguments.keep_powers)
    shown = [name for name in ("held-out, fitted", "each garment left out", *found["levels"]) if name in found["levels"]][:2]
    lines = {f"{name}: {group}": curve for name in shown for group, curve in found["levels"][name].items()}
    diagrams.reliability_diagram(arguments.diagram, lines)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())

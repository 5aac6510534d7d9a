"""Result files: the results of the studies in a folder, and means over their cells."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddakf.errors import InvalidFile
from ddakf.evaluation import machine, statistics
from ddakf.evaluation.splits import TUNED, UNTOUCHED, is_untouched

UNTRACEABLE = "has runs of uncommitted or vanished code"


class Pooled(NamedTuple):
    """A number of the report: mean and SD over the runs of the mean over sequences and views."""

    mean: float
    sd: float | None  # None with one run
    runs: int  # seeds that all cells have; 0: none, and the mean is over the cells
    cells: int  # sequences x views with the value
    cells_in_all: int  # sequences x views of the method, with or without the value


@dataclass(frozen=True)
class Result:
    """A study's result.

    Attributes:
        name: of the file, without its ending.
        meta: command, versions, seeds, machine.
        cells: by sequence, view and method.
        p_values: see :func:`ddakf.evaluation.studies.study_summary.tests`.
    """

    name: str
    meta: dict
    cells: list[dict]
    p_values: dict

    @property
    def methods(self) -> list[str]:
        return list(dict.fromkeys(cell["method"] for cell in self.cells))

    @property
    def sequences(self) -> list[str]:
        return list(dict.fromkeys(cell["sequence"] for cell in self.cells))

    @property
    def views(self) -> list[str]:
        return list(dict.fromkeys(cell["view"] for cell in self.cells))

    def cells_of(self, method: str, chosen: Callable[[dict], bool] = lambda cell: True) -> list[dict]:
        """The cells of a method."""
        return [cell for cell in self.cells if cell["method"] == method and chosen(cell)]

    def pooled(self, method: str, value: str, chosen: Callable[[dict], bool] = lambda cell: True) -> Pooled | None:
        """The mean of a value over the cells of a method; None if no run has the value."""
        cells = self.cells_of(method, chosen)
        by_seed: dict[int, list[float]] = {}
        used = 0
        for cell in cells:
            values = {run["seed"]: run[value] for run in cell["runs"] if run.get(value) is not None}
            used += bool(values)
            for seed, number in values.items():
                by_seed.setdefault(seed, []).append(number)
        if not used:
            return None
        means = [np.mean(numbers) for numbers in by_seed.values() if len(numbers) == used]
        if not means:  # no seed has a value everywhere
            return Pooled(float(np.mean([cell["mean"][value] for cell in cells if _has(cell, value)])), None, 0, used, len(cells))
        sd = float(np.std(means, ddof=1)) if len(means) > 1 else None
        return Pooled(float(np.mean(means)), sd, len(means), used, len(cells))

    def reason(self, method: str) -> str:
        """The reason why a method has no numbers in some cells; empty if it has all."""
        sentences = [cell.get("failed") or cell.get("not_applicable") for cell in self.cells_of(method)]
        return "; ".join(dict.fromkeys(filter(None, sentences)))

    def lost(self, method: str, chosen: Callable[[dict], bool] = lambda cell: True) -> int:
        """Number of cells in which a run of the method lost the garment."""
        return sum(any(_lost(cell)) for cell in self.cells_of(method, chosen))

    def mostly_lost(self, method: str, chosen: Callable[[dict], bool] = lambda cell: True) -> bool:
        """True if the method lost the garment in more than half of its runs."""
        runs = [lost for cell in self.cells_of(method, chosen) for lost in _lost(cell)]
        return 2 * sum(runs) > len(runs)

    @property
    def untraceable(self) -> str | None:
        """A sentence on runs of code that nobody can check out: uncommitted changes, commits that vanished; None without any."""
        runs = [run for cell in self.cells for run in cell["runs"]]
        names = {run[key] for run in runs for key in ("commit", "times_commit") if key in run} | set(self.meta["commits"])
        if lost := sorted(name for name in names if not machine.is_traceable(name)):
            return f"{self.name}.json {UNTRACEABLE}: {', '.join(lost)}."
        return None

    @property
    def constants(self) -> str:
        """A sentence on how many sequences are untouched."""
        untouched = sum(is_untouched(name) for name in self.sequences)
        parts = [f"{count} {word}" for count, word in ((untouched, UNTOUCHED), (len(self.sequences) - untouched, TUNED)) if count]
        return f"{self.name}.json: {', '.join(parts)} sequences."

    @property
    def mixed_runs(self) -> str | None:
        """A sentence on runs of several commits, machines or numbers of processes, and on times of earlier commits, or None."""
        commits: dict[str, dict[str, None]] = {commit: {} for commit in self.meta["commits"]}
        times: dict[str, dict[str, None]] = {}
        processes, machines = set(), set()
        for cell in self.cells:
            for run in cell["runs"]:
                processes.add(run.get("processes"))
                machines.add(run.get("cpu"))
                if "times_commit" in run:
                    times.setdefault(run["times_commit"], {})[cell["method"]] = None
                if "commit" in run:
                    commits.setdefault(run["commit"], {})[cell["method"]] = None
        parts = []
        if len(commits) > 1:
            named = (f"{commit} ({', '.join(methods)})" if methods else commit for commit, methods in commits.items())
            parts.append(f"runs of several commits: {', '.join(named)}")
        if times:
            parts.append("times of earlier commits: " + ", ".join(f"{c} ({', '.join(methods)})" for c, methods in times.items()))
        if len(machines - {None}) > 1:
            parts.append(f"times of {' and '.join(sorted(machines - {None}))}")
        if len(processes - {None}) > 1:
            parts.append(f"times with {' and '.join(map(str, sorted(processes - {None})))} processes at once")
        return f"{self.name}.json has {'; '.join(parts)}." if parts else None


def _lost(cell: dict) -> list[bool]:
    """For each run with a truth, and each that failed, True if it lost the garment."""
    errors = [run["rmse_mm"] for run in cell["runs"] if run["rmse_mm"] is not None]
    return statistics.lost(errors + [None] * cell.get("failed_runs", 0))


def _has(cell: dict, value: str) -> bool:
    return cell["mean"] is not None and cell["mean"].get(value) is not None


def read(folder: Path) -> dict[str, Result]:
    """All results in a folder, by name.

    Raises:
        InvalidFile: none there, or a file that is no result.
    """
    found = {path.stem: read_one(path) for path in sorted(Path(folder).glob("*.json"))}
    if not found:
        raise InvalidFile(str(folder), "results of studies (*.json): ddakf evaluate --paper makes them", "none")
    return found


def read_one(path: Path) -> Result:
    """The result in a file.

    Raises:
        InvalidFile: no result.
    """
    try:
        content = json.loads(path.read_text())
        return Result(path.stem, content["meta"], content["results"], content["p_values"])
    except OSError as error:
        raise InvalidFile(str(path), "the result of a study", error.strerror or "none") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidFile(str(path), "the result of a study", f"{type(error).__name__}: {error}") from error

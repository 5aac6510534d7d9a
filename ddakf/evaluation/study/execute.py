"""Runs the trials of a study that have not been run, with the time that is left."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from contextlib import closing

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ddakf.evaluation import machine
from ddakf.evaluation.study import workers
from ddakf.evaluation.study.journal import Journal
from ddakf.evaluation.trials import Trial

SPEED_OVER = 3600.0  # s: the time left is judged by the runs of the last hour at most
ALL = "all"  # for the names of all systems


def execute(wanted: list[Trial], journal: Journal, procs: int, console: Console, again: Collection[str] = ()) -> None:
    """Runs what the journal lacks, and adds it there as it comes.

    Args:
        wanted: in the order in which they are run.
        journal: see :class:`~ddakf.evaluation.study.journal.Journal`.
        procs: processes; each computes with one thread.
        console: for progress.
        again: systems, or :data:`ALL`, whose trials are run again where they are of other code or did not apply.
    """
    code = machine.code()
    kept = [trial for trial in wanted if journal.done(trial) and not (_named(trial, again) and not journal.current(trial, code))]
    if kept:
        console.print(f"{len(kept)} of {len(wanted)} runs are in {journal.path}")
        _say_which_are_older(journal.rows(kept), code, console)
    if missing := [trial for trial in wanted if trial not in set(kept)]:
        _run(missing, journal, procs, console, {"commit": code, "processes": procs})


def _named(trial: Trial, systems: Collection[str]) -> bool:
    return ALL in systems or trial.variant in systems


def _say_which_are_older(rows: list[dict], code: str, console: Console) -> None:
    """Results of several versions beside each other are no error, but nobody shall overlook them."""
    others = [row for row in rows if row.get("commit") != code]
    if not others:
        return
    counts = Counter(str(row.get("commit")) for row in others)
    commits = ", ".join(f"{commit}: {count}" for commit, count in counts.items())
    systems = ",".join(dict.fromkeys(row["variant"] for row in others))
    console.print(f"{len(others)} of them are of other code than {code} ({commits}); --again {systems} runs them again")


def _run(missing: list[Trial], journal: Journal, procs: int, console: Console, origin: dict) -> None:
    columns = (TextColumn("{task.fields[what]:36.36s}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("left:"), TimeRemainingColumn())  # fmt: skip
    with (
        Progress(*columns, console=console, speed_estimate_period=SPEED_OVER) as bar,
        closing(workers.rows(missing, procs)) as rows,
    ):
        task = bar.add_task("", total=len(missing), what="starting")
        for row in rows:
            journal.add(origin | row)
            bar.update(task, advance=1, what=title(row))
            if not console.is_terminal:  # no bar in a log
                console.print(_line(bar.tasks[0], title(row)))
            if "failed" in row:
                bar.console.print(f"{title(row)}: {row['failed']}")


def _line(task: Task, what: str) -> str:
    left = "" if task.time_remaining is None else f", {task.time_remaining / 60:.0f} min left"
    return f"{task.completed:.0f} of {task.total:.0f}: {what}{left}"


def title(row: dict) -> str:
    """The trial in a few words."""
    return f"{row['sequence']} {row['view']}{'+body' if row['body'] else ''} {row['variant']}, seed {row['seed']}"

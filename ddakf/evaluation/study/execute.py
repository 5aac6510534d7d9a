"""Runs the trials of a study that have not been run, in several processes, with the time that is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from multiprocessing import get_context

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from threadpoolctl import threadpool_limits

from ddakf import kernels
from ddakf.evaluation import machine, trials
from ddakf.evaluation.study.journal import Journal
from ddakf.evaluation.trials import Trial

SPEED_OVER = 3600.0  # s: the time left is judged by the runs of the last hour at most


def execute(wanted: list[Trial], journal: Journal, procs: int, console: Console) -> None:
    """Runs what the journal lacks, and adds it there as it comes.

    Args:
        wanted: in the order in which they are run.
        journal: see :class:`~ddakf.evaluation.study.journal.Journal`.
        procs: processes; each computes with one thread.
        console: for progress.
    """
    missing = [trial for trial in wanted if not journal.done(trial)]
    if len(missing) < len(wanted):
        console.print(f"{len(wanted) - len(missing)} of {len(wanted)} runs are in {journal.path}")
    if not missing:
        return
    columns = (TextColumn("{task.fields[what]:48.48s}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("left:"), TimeRemainingColumn())  # fmt: skip
    with (
        Progress(*columns, console=console, speed_estimate_period=SPEED_OVER) as bar,
        closing(_run(missing, procs)) as rows,
    ):
        task = bar.add_task("", total=len(missing), what="starting")
        for row in rows:
            journal.add(row)
            bar.update(task, advance=1, what=title(row))
            if "failed" in row:
                bar.console.print(f"{title(row)}: {row['failed']}")


def _run(missing: list[Trial], procs: int) -> Iterator[dict]:
    commit = machine.commit()
    run: Callable[[Trial], dict] = trials.run
    if procs == 1:
        prepare()
        for trial in missing:
            yield {"commit": commit} | run(trial)
        return
    with get_context("spawn").Pool(procs, prepare) as pool:
        for row in pool.imap_unordered(run, missing):
            yield {"commit": commit} | row


def prepare() -> None:
    """One thread, and compiled kernels: no time holds anything else."""
    threadpool_limits(1)
    kernels.warm()


def title(row: dict) -> str:
    """The trial in a few words."""
    return f"{row['sequence']} {row['view']}{'+body' if row['body'] else ''} {row['variant']}, seed {row['seed']}"

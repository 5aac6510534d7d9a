"""Runs the trials of a study that have not been run, with the time that is left."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections import Counter
from collections.abc import Collection
from contextlib import closing
from dataclasses import fields
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ddakf.evaluation import machine
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.studies import study_summary, worker_processes
from ddakf.evaluation.studies.row_log import RowLog
from ddakf.evaluation.studies.study_plan import StudyPlan
from ddakf.evaluation.trials.trial import Trial

SPEED_OVER = 3600.0  # s: the time left is judged by the runs of the last hour at most
ALL = "all"  # for the names of all systems


def execute(wanted: list[Trial], journal: RowLog, procs: int, console: Console, again: Collection[str] = ()) -> None:
    """Runs what the journal lacks, and adds it there as it comes.

    Args:
        wanted: in the order in which they are run.
        journal: see :class:`~ddakf.evaluation.studies.row_log.RowLog`.
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


def _run(missing: list[Trial], journal: RowLog, procs: int, console: Console, origin: dict) -> None:
    columns = (TextColumn("{task.fields[what]:36.36s}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("left:"), TimeRemainingColumn())  # fmt: skip
    with (
        Progress(*columns, console=console, speed_estimate_period=SPEED_OVER) as bar,
        closing(worker_processes.rows(missing, procs)) as rows,
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


def run_study(plan: StudyPlan, out: Path, procs: int, console: Console, again: Collection[str] = ()) -> dict:
    """Runs what is missing of a checked plan, and what is to be run again, writes its result and returns it."""
    wanted, journal = plan.trials(), RowLog(out.with_suffix(".rows.jsonl"))
    try:
        execute(wanted, journal, procs, console, again)
    except KeyboardInterrupt:
        done = sum(map(journal.done, wanted))
        console.print(f"interrupted; {done} of {len(wanted)} runs are in {journal.path}, the same command goes on from there")
        raise
    rows = journal.rows(wanted)
    meta = {
        "command": "ddakf " + shlex.join(sys.argv[1:]),
        "date": time.strftime("%Y-%m-%d"),
        "commits": sorted({str(row["commit"]) for row in rows}),
        "machine": machine.describe() | {"processes": procs},
        "seeds": list(range(1, plan.runs + 1)),
        "frames": plan.frames,
        "conditions": {f.name: getattr(plan.settings, f.name) for f in fields(Sensor) if f.name != "view"} | plan.unheeded(),
    }
    result = study_summary.summed_up(rows, meta)
    out.write_text(result_json(result))
    return result


def result_json(result: dict) -> str:
    """JSON with a line per cell, so that versions can be compared."""
    cells = ",\n  ".join(json.dumps(cell) for cell in result["results"])
    parts = [f'"meta": {json.dumps(result["meta"], indent=1)}', f'"results": [\n  {cells}\n ]',
             f'"p_values": {json.dumps(result["p_values"], indent=1)}']  # fmt: skip
    return "{\n" + ",\n".join(parts) + "\n}\n"

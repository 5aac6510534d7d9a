"""Execution of a study: missing trials run in worker processes, with progress; then the result file is written."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import fields
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ddakf.errors import InvalidArgument
from ddakf.evaluation import machine
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.studies import study_summary, worker_processes
from ddakf.evaluation.studies.kept_rows import kept_rows
from ddakf.evaluation.studies.row_log import RowLog
from ddakf.evaluation.studies.study_plan import StudyPlan
from ddakf.evaluation.trials.inputs import digest_of
from ddakf.evaluation.trials.recordings import location
from ddakf.evaluation.trials.trial import Trial

SPEED_OVER = 3600.0  # s: window of the runs from which the remaining time is estimated, an hour
ALL = "all"  # stands for all systems in --again


def execute(
    wanted: list[Trial],
    row_log: RowLog,
    procs: int,
    console: Console,
    again: Collection[str] = (),
    *,
    keep_times: bool = False,
) -> None:
    """Runs the trials that the log lacks, and appends each row when it is finished.

    Args:
        wanted: in the order in which they are run.
        row_log: of finished trials, see :class:`~ddakf.evaluation.studies.row_log.RowLog`.
        procs: processes; each computes with one thread.
        console: for progress.
        again: systems, or :data:`ALL`, whose trials run again if they are of another commit or did not apply.
        keep_times: a trial that runs again keeps its earlier times, with their commit: this machine is not that of the others.
    """
    code, cpu = machine.code_version(), machine.describe()["cpu"]

    def finished(trial: Trial) -> bool:
        return row_log.done(trial) and not row_log.outdated(trial) and (row_log.current(trial, code) or not _chosen(trial, again))

    if changed := [trial for trial in wanted if row_log.done(trial) and row_log.outdated(trial)]:
        what = ", ".join(dict.fromkeys(f"{trial.sequence} with {trial.variant}" for trial in changed))
        sentence = f"{len(changed)} runs are made again, as the recording or the tracker is another: {what}"
        console.print(sentence, markup=False, soft_wrap=True)
    done_trials = [trial for trial in wanted if finished(trial)]
    if done_trials:
        console.print(f"{len(done_trials)} of {len(wanted)} runs are in {row_log.path}")
        _report_other_commits(row_log.rows(done_trials), code, console)
    if missing := [trial for trial in wanted if trial not in set(done_trials)]:
        earlier = {Trial.from_row(row): row for row in row_log.rows(missing)} if keep_times else {}
        for row in _run(missing, procs, console):
            trial = Trial.from_row(row)
            digest = digest_of(trial)
            inputs = {} if digest is None else {"inputs": digest}
            times = study_summary.times(earlier[trial]) if trial in earlier and "not_applicable" not in row else {}
            load = {"load_average": round(os.getloadavg()[0], 2)}
            row_log.add({"commit": code, "processes": procs, "cpu": cpu} | inputs | load | row | times)


def systems_again(text: str, systems: Collection[str]) -> list[str]:
    """The systems of ``--again A,B``.

    Raises:
        InvalidArgument: one that is none of these systems, nor :data:`ALL`.
    """
    names = [name for name in text.split(",") if name]
    if unknown := [name for name in names if name not in {ALL, *systems}]:
        raise InvalidArgument("again", f"{ALL}, or some of {', '.join(sorted(systems))}", unknown[0])
    return names


def _chosen(trial: Trial, systems: Collection[str]) -> bool:
    return ALL in systems or trial.variant in systems


def _report_other_commits(rows: list[dict], code: str, console: Console) -> None:
    """Prints how many rows are of another commit. Results of several commits are valid, but must not go unnoticed."""
    others = [row for row in rows if row.get("commit") != code]
    if not others:
        return
    counts = Counter(str(row.get("commit")) for row in others)
    commits = ", ".join(f"{commit}: {count}" for commit, count in counts.items())
    systems = ",".join(dict.fromkeys(row["variant"] for row in others))
    console.print(f"{len(others)} of them are of other code than {code} ({commits}); --again {systems} runs them again")


def _run(missing: list[Trial], procs: int, console: Console) -> Iterator[dict]:
    """The row of each trial when it is finished, with progress."""
    columns = (TextColumn("{task.fields[what]:36.36s}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("left:"), TimeRemainingColumn())  # fmt: skip
    with (
        Progress(*columns, console=console, speed_estimate_period=SPEED_OVER) as bar,
        closing(worker_processes.rows(missing, procs)) as rows,
    ):
        task = bar.add_task("", total=len(missing), what="starting")
        for row in rows:
            yield row
            bar.update(task, advance=1, what=title(row))
            if not console.is_terminal:  # no bar in a log
                console.print(_line(bar.tasks[0], title(row)), markup=False)
            if "failed" in row:
                bar.console.print(f"{title(row)}: {row['failed']}", markup=False)


def _line(task: Task, what: str) -> str:
    left = "" if task.time_remaining is None else f", {task.time_remaining / 60:.0f} min left"
    return f"{task.completed:.0f} of {task.total:.0f}: {what}{left}"


def title(row: dict) -> str:
    """Short name of a trial."""
    return f"{row['sequence']} {row['view']}{'+body' if row['body'] else ''} {row['variant']}, seed {row['seed']}"


def run_study(
    plan: StudyPlan,
    out: Path,
    procs: int,
    console: Console,
    again: Collection[str] = (),
    *,
    keep_times: bool = False,
    others: Collection[Path] = (),
    allow_dirty: bool = False,
) -> dict:
    """Runs the missing trials of a checked plan and those of ``again``, writes the result file and returns the result.

    Args:
        plan: of the study.
        out: result file; the row log lies beside it.
        procs: processes.
        console: for progress.
        again, keep_times: see :func:`execute`.
        others: result files of other studies, whose runs are taken over where they are of the same trial.
        allow_dirty: also with uncommitted code.

    Raises:
        InvalidArgument: uncommitted code, for a result of the checkout, without ``allow_dirty``; a result file in the folder of a
            recording.
    """
    machine.require_committed(out, allow_dirty)
    for name in plan.sequences:
        if (place := location(name)) and place.resolve() in out.resolve().parents:
            raise InvalidArgument("json", f"a file outside of {place}, which is tracked", str(out))
    wanted, row_log = plan.trials(), _log_of(out)
    for other in others:
        if taken := row_log.take_over(wanted, _log_of(other, append=False)):
            console.print(f"{taken} of {len(wanted)} runs are taken over from {other.stem}")
    try:
        execute(wanted, row_log, procs, console, again, keep_times=keep_times)
    except KeyboardInterrupt:
        done = sum(map(row_log.done, wanted))
        console.print(f"interrupted; {done} of {len(wanted)} runs are in {row_log.path}, the same command goes on from there")
        raise
    rows = row_log.rows(wanted)
    meta = {
        "command": "ddakf " + shlex.join(sys.argv[1:]),
        "date": time.strftime("%Y-%m-%d"),
        "commits": sorted({str(row["commit"]) for row in rows if "not_applicable" not in row}),
        "machine": machine.describe() | {"processes": procs},
        "seeds": list(range(1, plan.runs + 1)),
        "frames": plan.frames,
        "surfaces": plan.settings.surfaces,
        "seconds": round(sum(row.get("seconds") or 0.0 for row in rows)),
        "conditions": {f.name: getattr(plan.settings, f.name) for f in fields(Sensor) if f.name != "view"} | plan.unheeded(),
    }
    result = study_summary.summarise(rows, meta)
    part = out.with_name(out.name + ".part")
    part.write_text(result_json(result))
    part.replace(out)  # as a whole: a result that was cut off would not be read again
    return result


def _log_of(out: Path, append: bool = True) -> RowLog:
    """The row log beside a result file, with the runs of the result."""
    return RowLog(out.with_suffix(".rows.jsonl"), kept_rows(out), append=append)


def result_json(result: dict) -> str:
    """JSON with a line per cell, so that diffs of two versions are readable."""
    cells = ",\n  ".join(json.dumps(cell) for cell in result["results"])
    parts = [f'"meta": {json.dumps(result["meta"], indent=1)}', f'"results": [\n  {cells}\n ]',
             f'"p_values": {json.dumps(result["p_values"], indent=1)}']  # fmt: skip
    return "{\n" + ",\n".join(parts) + "\n}\n"

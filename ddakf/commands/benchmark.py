"""``ddakf benchmark``: the untouched simulated recordings as a benchmark for any tracker."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from ddakf.errors import InvalidArgument


def register(commands: argparse._SubParsersAction) -> None:
    """Adds the command and its parts to the parser."""
    parser = commands.add_parser("benchmark", help="compare any tracker on the untouched simulated recordings")
    parts = parser.add_subparsers(dest="part", metavar="PART", required=True)
    _add_make(parts)
    _add_run(parts)
    table = parts.add_parser("table", help="results in Markdown: systems by conditions, and the ratio to the best baseline")
    table.add_argument("result", type=Path, metavar="RESULT.json", help="result of ddakf benchmark run")
    table.set_defaults(run=_table)


def _add_make(parts: argparse._SubParsersAction) -> None:
    make = parts.add_parser("make", help="copy or simulate the recordings, and compare them with their checksums")
    make.add_argument("--folder", type=Path, required=True, metavar="DIR", help="folder for the recordings, 6 MB")
    make.add_argument("--only", nargs="+", default=[], metavar="NAME", help="make these recordings alone")
    make.add_argument("--anew", action="store_true", help="simulate also what this checkout has (a minute each)")
    make.set_defaults(run=_make)


def _add_run(parts: argparse._SubParsersAction) -> None:
    run = parts.add_parser("run", help="track every recording in every condition; resumes where it was stopped")
    run.add_argument(
        "--submit",
        action="append",
        default=[],
        metavar="MODULE:CLASS",
        help="a tracker of your own, by import: a class with start and step",
    )
    run.add_argument("--methods", default="ddakf", metavar="A,B", help="other systems to compare (default ddakf)")
    run.add_argument("--folder", type=Path, metavar="DIR", help="folder of the recordings (default: those of the checkout)")
    run.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help="track these recordings alone: no result of the benchmark"
    )
    run.add_argument(
        "--runs", type=int, metavar="N", help="runs, with seeds 1 to N (default 5): fewer are no result of the benchmark"
    )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    run.add_argument(
        "--procs", type=int, default=cores, metavar="N", help=f"number of processes (default {cores}; 1 for exact times)"
    )
    run.add_argument("--json", type=Path, required=True, metavar="OUT.json", help="file for the result")
    run.add_argument("--again", default="", metavar="A,B", help="run these systems again where they ran with other code, or all")
    run.add_argument("--allow-dirty", action="store_true", help="write into results/ although the code has uncommitted changes")
    run.set_defaults(run=_run)


def _make(arguments: argparse.Namespace) -> int:
    from ddakf.evaluation import benchmark

    version = benchmark.load()
    if unknown := set(arguments.only) - {each.name for each in version.recordings}:
        raise InvalidArgument("only", f"recordings of {version.title}", ", ".join(sorted(unknown)))
    benchmark.make(version, arguments.folder, lambda sentence: print(sentence, flush=True), arguments.only, arguments.anew)
    return 0


def _run(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from ddakf.evaluation import benchmark
    from ddakf.evaluation.datasets import collection
    from ddakf.evaluation.studies.execution import run_study, systems_again

    for name in ("procs", "runs"):
        if (number := getattr(arguments, name)) is not None and number < 1:
            raise InvalidArgument(name, "at least 1", str(number))
    version, console = benchmark.load(), Console(stderr=True)
    folder = arguments.folder or collection.folder()
    systems = dict.fromkeys([*(part for part in arguments.methods.split(",") if part), *arguments.submit])
    plan = version.plan(systems, folder, arguments.only, arguments.runs)
    wanted = {Path(name).stem for name in plan.sequences}
    if others := [line for line in benchmark.differing(version, folder) if line.partition(":")[0] in wanted]:
        raise InvalidArgument("folder", f"the recordings of {version.title}", f"{len(others)} others, as {others[0]}")
    plan.check()
    again = systems_again(arguments.again, plan.systems)
    run_study(plan, arguments.json, arguments.procs, console, again, allow_dirty=arguments.allow_dirty)
    whole = len(plan.sequences) == len(version.recordings) and plan.runs == version.runs
    console.print(f"{version.title}{'' if whole else ', a part'}: {arguments.json}; ddakf benchmark table {arguments.json}")
    return 0


def _table(arguments: argparse.Namespace) -> int:
    from ddakf.evaluation.reporting import headline, markdown, result_files

    print(markdown.section(headline.table(result_files.read_one(arguments.result)), arguments.result.parent))
    return 0

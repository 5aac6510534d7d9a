"""``ddakf evaluate``: the systems of the paper on sequences with truth, with statistics, into one JSON file."""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict, replace
from pathlib import Path

from ddakf.commands import sensor_options
from ddakf.errors import InvalidArgument

EPILOG = """
Every system gets the same clouds. Finished runs are stored in OUT.rows.jsonl: the same command resumes after an interruption,
and a larger one (more runs, systems, views, sequences) adds only the missing runs. A method that fails or cannot be used does
not stop the others; its row has the reason.
"""


WIDE = 140  # least characters of the table: a narrow terminal wraps lines instead of truncating numbers
SHOWN = ("rmse_mm", "rmse_normal_mm", "hausdorff_mm", "iou", "penetration_mm", "flicker", "residual_mm", "own_flicker",
         "held_out_share", "limb_mm", "drift_mm", "end_point_error_mm", "ms_per_frame")  # fmt: skip


def register(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = commands.add_parser("evaluate", help="compare the systems of the paper on sequences with truth", epilog=EPILOG)
    what = "sequence: sample, a name under DDAKF_DATA, or a path: .npz, MPI-FAUST#s3_p7, a folder, ... (docs/datasets.md)"
    parser.add_argument("sequences", nargs="*", metavar="SEQ", help=what)
    parser.add_argument(
        "--paper", action="store_true", help="run all studies of the paper's tables, into --results; SEQ: default all available"
    )
    parser.add_argument(
        "--quick", action="store_true", help="with --paper, a small study: 2 sequences, 3 conditions, 2 seeds, 30 frames"
    )
    parser.add_argument(
        "--only", default="", metavar="A,B", help="with --paper, these studies and figures alone, such as main,figure-1"
    )
    what = "leave out Hausdorff distances and silhouettes, which take longer than a frame"
    parser.add_argument("--no-surfaces", action="store_true", help=what)
    parser.add_argument(
        "--results", type=Path, default=Path("results"), metavar="DIR", help="folder for the results of --paper (default results)"
    )
    what = "systems to compare (default ddakf,paper,kf,icp,pf,clothfit,opt-ed,nicp; with --paper: those of each study)"
    parser.add_argument("--methods", default="", metavar="A,B", help=what)
    parser.add_argument("--runs", type=int, metavar="N", help="runs of each cell, with seeds 1 to N (default 5, with --quick 2)")
    parser.add_argument("--frames", default=":", metavar="A:B", help="frames: from A, where the garment is known, to B - 1")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    parser.add_argument(
        "--procs", type=int, default=cores, metavar="N", help=f"number of processes (default {cores}; 1 for exact times)"
    )
    what = "run these systems again, or all, if their runs are of another commit or did not apply"
    parser.add_argument("--again", default="", metavar="A,B", help=what)
    what = "keep the earlier times of runs that are made again, as times of two machines do not compare"
    parser.add_argument("--keep-times", action="store_true", help=what)
    what = "a tracker of your own, by import: a class with start and step (docs/benchmark.md); beside --methods"
    parser.add_argument("--submit", action="append", default=[], metavar="MODULE:CLASS", help=what)
    what = "write into results/ of the checkout although its code has uncommitted changes"
    parser.add_argument("--allow-dirty", action="store_true", help=what)
    parser.add_argument("--json", type=Path, metavar="OUT.json", help="file for the result; needed without --paper")
    sensor_options.add(parser, several_views=True)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Checks the arguments, runs the missing trials, writes the result and prints a table."""
    from rich.console import Console

    from ddakf.evaluation.paper_scope import RUNS, SYSTEMS
    from ddakf.evaluation.studies.execution import run_study, systems_again
    from ddakf.evaluation.studies.study_plan import StudyPlan
    from ddakf.evaluation.trials.trial import Trial

    for name in ("procs", "runs"):
        if (number := getattr(arguments, name)) is not None and number < 1:
            raise InvalidArgument(name, "at least 1", str(number))
    if arguments.paper:
        _refuse_beside_paper(arguments)
        return _paper(arguments, Console(stderr=True))
    for name in ("quick", "only"):
        if given := getattr(arguments, name):
            raise InvalidArgument(name, "to be used with --paper", str(given))
    if arguments.json is None:
        raise InvalidArgument("json", "OUT.json for the result, or --paper", "neither")
    if arguments.json.suffix != ".json":
        raise InvalidArgument("json", "a name that ends in .json", str(arguments.json))
    if not arguments.json.parent.is_dir():
        raise InvalidArgument("json", "a file in a folder that exists", str(arguments.json))
    sensor = asdict(sensor_options.sensor(arguments, view="ring4"))  # the plan sets the view, and checks the sensor with it
    settings = Trial("", **sensor, surfaces=not arguments.no_surfaces)
    methods = (*(tuple(_names(arguments.methods)) or (("ddakf",) if arguments.submit else SYSTEMS)), *arguments.submit)
    sequences, views = tuple(arguments.sequences), tuple(_names(arguments.view))
    plan = StudyPlan(sequences, methods, views, arguments.runs or RUNS, arguments.frames, settings)
    plan.check()
    plan.require_all_frames()
    if plan.unheeded() and arguments.view != "full":
        raise InvalidArgument("view", "none for recordings of real sensors, which saw what they saw", arguments.view)
    console, again = Console(stderr=True), systems_again(arguments.again, plan.systems)
    result = run_study(plan, arguments.json, arguments.procs, console, again, **_how(arguments))
    shown = Console()
    shown.width = max(shown.width, WIDE)
    shown.print(table(result))
    for reason in reasons(result):
        shown.print(reason, markup=False, soft_wrap=True)
    console.print(str(arguments.json))
    return 1 if all("failed" in cell and not cell["runs"] for cell in result["results"]) else 0


def _how(arguments: argparse.Namespace) -> dict[str, bool]:
    return {"keep_times": arguments.keep_times, "allow_dirty": arguments.allow_dirty}


def _refuse_beside_paper(arguments: argparse.Namespace) -> None:
    """Refuses options of the sensor and --json with --paper, whose studies set them."""
    beside = argparse.ArgumentParser()
    sensor_options.add(beside, several_views=True)
    default = vars(beside.parse_args([])) | {"json": None}
    if changed := [name for name, value in default.items() if getattr(arguments, name) != value]:
        raise InvalidArgument(changed[0], "nothing beside --paper", str(getattr(arguments, changed[0])))


def _paper(arguments: argparse.Namespace, console) -> int:
    """Runs all studies of the report."""
    from ddakf.evaluation.paper_scope import ERROR_MAPS
    from ddakf.evaluation.studies import paper_studies
    from ddakf.evaluation.studies.execution import run_study, systems_again

    size = paper_studies.QUICK if arguments.quick else paper_studies.FULL
    if arguments.runs:
        size = replace(size, runs=arguments.runs, swept_runs=arguments.runs)
    if arguments.frames != ":":
        size = replace(size, frames=arguments.frames, moving=arguments.frames)
    plans = paper_studies.studies(size, arguments.sequences or None)
    everything = [arguments.results / f"{name}.json" for name in plans]
    parts = [*plans, *ERROR_MAPS]
    chosen = _names(arguments.only) or parts
    if unknown := [name for name in chosen if name not in parts]:
        raise InvalidArgument("only", f"some of {', '.join(parts)}", unknown[0])
    plans = {name: plan for name, plan in plans.items() if name in chosen}
    if methods := _names(arguments.methods):
        if not plans:
            raise InvalidArgument("methods", "none for figures alone, which show all", methods[0])
        known = dict.fromkeys(system for plan in plans.values() for system in plan.systems)
        if unknown := [method for method in methods if method not in known]:
            raise InvalidArgument("methods", f"some of {', '.join(known)}", unknown[0])
        of_each = {name: tuple(system for system in plan.systems if system in methods) for name, plan in plans.items()}
        plans = {name: replace(plans[name], systems=systems) for name, systems in of_each.items() if systems}
    plans = {name: replace(plan, systems=(*plan.systems, *arguments.submit)) for name, plan in plans.items()}
    if arguments.no_surfaces:
        plans = {name: replace(plan, settings=replace(plan.settings, surfaces=False)) for name, plan in plans.items()}
    for plan in plans.values():
        plan.check()
    again = systems_again(arguments.again, {system for plan in plans.values() for system in plan.systems})
    arguments.results.mkdir(parents=True, exist_ok=True)
    for number, (name, plan) in enumerate(plans.items(), 1):
        console.print(f"[bold]{name}[/bold], study {number} of {len(plans)}: {len(plan.trials())} runs")
        out = arguments.results / f"{name}.json"
        run_study(plan, out, arguments.procs, console, again, others=everything, **_how(arguments))
    figures = [name for name in ERROR_MAPS if name in chosen]
    paper_studies.save_error_maps(figures, size, arguments.results, console, again=bool(again))
    console.print(f"ddakf report --results {arguments.results} renders them")
    return 0


def table(result: dict):
    """The means as a table for the terminal."""
    from rich.table import Table

    columns = [name for name in SHOWN if any(cell["mean"] and cell["mean"][name] is not None for cell in result["results"])]
    rows = Table("sequence", "view", "method", *columns, box=None, header_style="bold")
    for cell in result["results"]:
        place = Path(cell["sequence"]).name, cell["view"], cell["method"]
        if cell["mean"] is None:
            rows.add_row(*place, *("–" for _ in columns))
            continue
        values = ("" if cell["mean"][name] is None else f"{cell['mean'][name]:.3g}" for name in columns)
        rows.add_row(*place, *values)
    return rows


def reasons(result: dict) -> list[str]:
    """The reasons for missing runs, with the methods, sequences and views."""
    found = {}
    for cell in result["results"]:
        if sentence := cell.get("failed") or cell.get("not_applicable"):
            found.setdefault((cell["method"], sentence), []).append(f"{Path(cell['sequence']).name} {cell['view']}")
    return [f"{method}: {sentence} ({', '.join(places)})" for (method, sentence), places in found.items()]


def _names(text: str) -> list[str]:
    return [part for part in text.split(",") if part]

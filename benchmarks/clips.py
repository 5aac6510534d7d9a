"""The command of a benchmark that tracks clips of the collection in several ways and writes a row for each."""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from committed import parsed
from conditions import FRAMES, add_recordings, geometric, recordings

from ddakf.evaluation import machine


def main(
    argv: list[str] | None,
    title: str,
    result: Path,
    run: Callable[[tuple], list[dict]],
    ways: Iterable,
    table: Callable[[list[dict]], list[str]],
) -> int:
    """Runs and prints; returns the exit status.

    Args:
        argv: arguments of the command.
        title: its first line of help.
        result: where the rows go unless the command says otherwise.
        run: the rows of a recording's name, a way and a number of frames; of a module, as the workers are spawned.
        ways: of tracking a recording.
        table: lines in Markdown, of the rows.
    """
    parser = argparse.ArgumentParser(description=title)
    add_recordings(parser)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--procs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=result, metavar="JSON")
    parser.add_argument("--table", action="store_true", help="print that file in Markdown, and track nothing")
    arguments = parsed(parser, argv)
    if arguments.table:
        print("\n".join(table(json.loads(arguments.out.read_text())["rows"])))
        return 0
    jobs = list(itertools.product(recordings(parser, arguments), ways, [arguments.frames]))
    rows = []
    with multiprocessing.get_context("spawn").Pool(arguments.procs) as pool:
        for done, found in enumerate(pool.imap(run, jobs), start=1):
            rows += found
            print(f"{found[0]['recording']}, {done} of {len(jobs)}", file=sys.stderr, flush=True)
    head = {"commit": machine.commit(), "held_out": arguments.held_out, "frames": arguments.frames}
    lines = ",\n".join(f"  {json.dumps(row)}" for row in rows)
    arguments.out.write_text(f'{json.dumps(head)[:-1]}, "rows": [\n{lines}\n]}}\n')
    print("\n".join(table(rows)))
    return 0


def scores(rows: list[dict]) -> str:
    """The cell of some rows of the tracker: geometric mean of the RMSE, and means of coverage and reliability."""
    inside, reliable = (np.mean([row[key] for row in rows]) for key in ("coverage", "reliability"))
    return f"{geometric(rows, 'rmse_mm'):.1f}, {inside:.0%}, {reliable:.2f}"


def markdown(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Lines of a table, whose heads and rows begin with the first column."""
    first, *others = ("|".join(("", *(f" {cell} " if cell else " " for cell in cells), "")) for cells in (heads, *rows))
    return [first, "|---" * (first.count("|") - 1) + "|", *others]

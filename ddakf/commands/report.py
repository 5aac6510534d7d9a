"""``ddakf report``: the paper's tables and figures from a folder of results."""

from __future__ import annotations

import argparse
from pathlib import Path

RESULTS, OUT = Path("results"), Path("out/report")


def register(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = commands.add_parser("report", help="the paper's tables and figures from the results of ddakf evaluate --paper")
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="DIR", help=f"folder of ddakf evaluate --paper (default {RESULTS})"
    )
    parser.add_argument(
        "--out", type=Path, default=OUT, metavar="DIR", help=f"folder for index.html and the pictures (default {OUT})"
    )
    what = "documents into which the tables that they name are written too"
    parser.add_argument("--markdown", type=Path, nargs="+", default=[], metavar="DOC.md", help=what)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Writes the page and its pictures from existing results."""
    from rich.console import Console

    from ddakf.evaluation.reporting import content, markdown, result_files

    arguments.out.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    with console.status("rendering"):
        found = result_files.read(arguments.results)
        content.write(found, arguments.results, arguments.out)
        if arguments.markdown:
            tables = content.tables_of(found, arguments.results, brief=True)
            for document in arguments.markdown:
                document.write_text(markdown.rewritten(document, tables, arguments.results))
    Console().print(str(arguments.out / "index.html"))
    return 0

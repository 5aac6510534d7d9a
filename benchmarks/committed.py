"""Arguments of benchmarks that write results: uncommitted code does not write into the checkout's."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

READING = ("table", "show", "write")  # options with which a result file is only read


def parsed(
    parser: argparse.ArgumentParser, argv: Sequence[str] | None = None, target: str = "out", writing: Sequence[str] = ()
) -> argparse.Namespace:
    """The arguments, with ``--allow-dirty``.

    Ends the program with a sentence where its code has uncommitted changes and would write into the results of the checkout.

    Args:
        parser: without that option.
        argv: default those of the program.
        target: name of the argument with the file or folder of the result, which may be None.
        writing: names of the options without any of which nothing is written; none, if it always is.
    """
    what = "write into the checkout's results although its code has uncommitted changes"
    parser.add_argument("--allow-dirty", action="store_true", help=what)
    arguments = parser.parse_args(argv)
    given = {name for name, value in vars(arguments).items() if value}
    path, writes = getattr(arguments, target), not given & {*READING} and (not writing or given & {*writing})
    if path is not None and writes:
        from ddakf.errors import InvalidArgument  # here, as bench.py sets threads before numpy is imported
        from ddakf.evaluation import machine

        try:
            machine.require_committed(path, arguments.allow_dirty)
        except InvalidArgument as error:
            parser.error(str(error))
    return arguments

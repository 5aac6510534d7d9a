"""Registration of ``ddakf view``; its code is imported only when it runs."""

from __future__ import annotations

import argparse

from .later import later


def register(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``view``."""
    parser = subparsers.add_parser(
        "view",
        help="show a recording, a result or a server in the browser",
        description="Serves the dashboard with a recording of `ddakf record` or a result of `ddakf track --out`, until "
        "Ctrl-C; or opens the dashboard of a running server.",
    )
    parser.add_argument("file", nargs="?", metavar="RESULT.npz|RECORDING.mcap", help="file to show")
    parser.add_argument("--server", metavar="HOST[:PORT]", help="open the dashboard of this server (port 7702) instead")
    parser.add_argument("--browser", action=argparse.BooleanOptionalAction, default=True, help="open a browser")
    parser.set_defaults(run=later("view", "view"))

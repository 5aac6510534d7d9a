"""The command ``ddakf demo``; what it does is in ``demonstration.py``, which is imported only when it runs."""

from __future__ import annotations

import argparse
from pathlib import Path


def register_demo(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``demo``."""
    parser = subparsers.add_parser(
        "demo",
        help="track the bundled sample through a service of its own",
        description="Starts the service on free loopback ports, streams the bundled sample to it as a virtual depth "
        "camera sees it, 30 frames per second, and shows how well and how fast it is tracked.",
    )
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for picture, animation and log")
    parser.add_argument("--frames", type=int, default=None, metavar="N", help="only the first N frames")
    parser.add_argument("--view", choices=("front", "ring4", "full"), default="front", help="what the sensor sees")
    parser.add_argument("--keep", action="store_true", help="leave the service running")
    parser.add_argument("--json", action="store_true", help="the table as JSON")
    parser.set_defaults(run=_demo)


def _demo(args: argparse.Namespace) -> int:
    from .demonstration import demonstrate  # numba and Pillow would slow down every other command

    return demonstrate(args)

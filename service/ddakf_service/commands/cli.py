"""Registration of ``ddakf serve``, ``ddakf keys`` and ``ddakf demo``; their code is imported only when they run."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..settings import Settings, flag_of
from .serve_arguments import add_serve_arguments


def register_serve(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``serve``; one flag per setting."""
    parser = subparsers.add_parser(
        "serve",
        help="run the service in the foreground",
        description="Runs the service. Flags win over the environment (DDAKF_...), it over the file.",
    )
    add_serve_arguments(parser)
    parser.set_defaults(run=_serve)


def _serve(args: argparse.Namespace) -> int:
    from .serve import serve  # gRPC and FastAPI would slow down every other command

    return serve(args)


def register_keys(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``keys``."""
    parser = subparsers.add_parser(
        "keys",
        help="make, list and revoke API keys",
        description="Keys of the service, in its database. A running service follows a change within some seconds.",
    )
    for name in ("data_dir", "database_url"):
        parser.add_argument(flag_of(name), dest=f"setting_{name}", metavar="VALUE", help=Settings.model_fields[name].description)
    parser.add_argument("--config", metavar="FILE", help="the TOML file of the service (environment: DDAKF_CONFIG)")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    create = actions.add_parser("create", help="make a key and print it, once")
    create.add_argument("name", help="holder or purpose")
    create.add_argument(
        "--scope",
        action="append",
        choices=("stream", "read", "admin"),
        required=True,
        help="stream: the key's own sessions; read: all sessions and the metrics; admin: everything; may be repeated",
    )
    create.add_argument("--max-sessions", type=int, default=0, metavar="N", help="at a time; default: the service's setting")
    listing = actions.add_parser("list", help="show all keys, without their secrets")
    listing.add_argument("--json", action="store_true", help="as a JSON list")
    revoke = actions.add_parser("revoke", help="end a key")
    revoke.add_argument("id", help="as `list` shows it")
    parser.set_defaults(run=_keys)


def _keys(args: argparse.Namespace) -> int:
    from .keys import run

    return run(args)


def register_demo(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``demo``."""
    parser = subparsers.add_parser(
        "demo",
        help="track the bundled sample through a temporary service",
        description="Starts the service on free loopback ports, streams the bundled sample to it as a virtual depth "
        "camera sees it, 30 frames per second, and shows how well and how fast it is tracked.",
    )
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for picture, animation and log")
    parser.add_argument("--frames", type=int, default=None, metavar="N", help="only the first N frames")
    parser.add_argument("--view", choices=("front", "ring4", "full"), default="front", help="view of the sensor")
    parser.add_argument("--keep", action="store_true", help="leave the service running")
    parser.add_argument("--json", action="store_true", help="the table as JSON")
    parser.set_defaults(run=_demo)


def _demo(args: argparse.Namespace) -> int:
    from .demo import demonstrate

    return demonstrate(args)

"""Registration of the service's commands: serve, backup, restore, keys, demo; their code is imported only when they run."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from ..setting_sources import flag_of
from ..settings import Settings
from ..workers.fork_server import ForkServer
from .later import later
from .serve_arguments import add_serve_arguments

_DATABASE = ("data_dir", "database_url")


def register_serve(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``serve``, one flag per setting, and ``backup`` and ``restore`` of what it stores."""
    parser = subparsers.add_parser(
        "serve",
        help="run the service in the foreground",
        description="Runs the service. Flags win over the environment (DDAKF_...), it over the file.",
    )
    add_serve_arguments(parser)
    parser.set_defaults(run=run_serve)
    for name, run, text in (
        ("backup", "back_up", "write the data folder of a service, which may be running, into an archive"),
        ("restore", "restore", "make a data folder from an archive of `ddakf backup`"),
    ):
        parser = subparsers.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        parser.add_argument("file", type=Path, metavar="FILE.tar", help="archive: database, checkpoints and meshes")
        _add_folder_options(parser, ("data_dir",), default=None)
        parser.set_defaults(run=later("backup", run))


def run_serve(args: argparse.Namespace) -> int:
    """Runs ``serve`` with parsed arguments."""
    elsewhere = (args.setting_worker_kind or os.environ.get("DDAKF_WORKER_KIND")) == "ray"
    fork_server = None if args.print_config or elsewhere else ForkServer()  # loads while this process imports gRPC and FastAPI
    from .serve import serve  # which would slow down every other command

    return serve(args, fork_server)


def register_keys(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``keys``."""
    parser = subparsers.add_parser(
        "keys",
        help="make, list and revoke API keys",
        description="Keys of the service, in its database. A running service follows a change within some seconds.",
    )
    _add_folder_options(parser, _DATABASE, default=None)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    create = actions.add_parser("create", help="make a key and print it, once")
    create.add_argument("name", help="name of the key: its holder or purpose")
    create.add_argument(
        "--scope",
        action="append",
        choices=("stream", "read", "admin"),
        required=True,
        help="stream: the key's own sessions; read: all sessions and the metrics; admin: everything; may be repeated",
    )
    create.add_argument(
        "--max-sessions",
        type=int,
        default=0,
        metavar="N",
        help="largest number of live sessions of the key (default: the service's setting)",
    )
    create.add_argument(
        "--expires", metavar="30d|TIME", help="expiry: a number of m, h, d or w from now, or a time, ISO 8601 (default: never)"
    )
    create.add_argument(
        "--frames-per-second",
        type=float,
        default=0.0,
        metavar="N",
        help="largest frame rate of all its streams together (default: not limited)",
    )
    create.add_argument(
        "--requests-per-minute",
        type=float,
        default=0.0,
        metavar="N",
        help="largest number of calls and new streams per minute (default: not limited)",
    )
    create.add_argument(
        "--file", type=Path, metavar="FILE", help="write the key there, for its group to read, unless it holds one in force"
    )
    listing = actions.add_parser("list", help="show all keys, without their secrets")
    listing.add_argument("--json", action="store_true", help="print a JSON list")
    revoke = actions.add_parser("revoke", help="end a key")
    revoke.add_argument("id", help="id of the key, as `list` shows it")
    for action in (create, listing, revoke):  # on either side of the action; without a default, which would replace the value
        _add_folder_options(action.add_argument_group("database"), _DATABASE, default=argparse.SUPPRESS)
    parser.set_defaults(run=later("keys", "run"))


def _add_folder_options(parser: argparse._ActionsContainer, settings: tuple[str, ...], default: str | None) -> None:
    for name in settings:
        description = Settings.model_fields[name].description
        parser.add_argument(flag_of(name), dest=f"setting_{name}", metavar="VALUE", default=default, help=description)
    parser.add_argument(
        "--config", metavar="FILE", default=default, help="the TOML file of the service (environment: DDAKF_CONFIG)"
    )


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
    parser.add_argument("--export", type=Path, metavar="DIR", help="only write the sample as OBJ, PLY and JSON files")
    parser.add_argument("--json", action="store_true", help="print the table as JSON")
    parser.set_defaults(run=later("demo", "demonstrate"))

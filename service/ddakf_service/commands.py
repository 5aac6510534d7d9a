"""The commands ``ddakf serve`` and ``ddakf keys``; what they do is imported only when they run."""

from __future__ import annotations

import argparse

from .settings import Settings, flag_of


def register_serve(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``serve``; one flag per setting."""
    parser = subparsers.add_parser(
        "serve",
        help="run the service in the foreground",
        description="Runs the service. Flags win over the environment (DDAKF_...), it over the file.",
    )
    add_serve_arguments(parser)


def add_serve_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``serve`` on a parser of one's own."""
    parser.add_argument("--config", metavar="FILE", help="a TOML file with settings (environment: DDAKF_CONFIG)")
    parser.add_argument("--print-config", action="store_true", help="show the settings and where each is from, and end")
    parser.add_argument("--json", action="store_true", help="progress, addresses and settings as JSON lines")
    parser.add_argument("--with-parent", action="store_true", help="stop when standard input closes")
    for name, field in Settings.model_fields.items():
        switch = {"nargs": "?", "const": "true"} if field.annotation is bool else {}
        parser.add_argument(flag_of(name), dest=f"setting_{name}", metavar="VALUE", help=field.description, **switch)
    parser.set_defaults(run=_serve)


def _serve(args: argparse.Namespace) -> int:
    from .serve import serve  # gRPC and FastAPI would slow down every other command

    return serve(args)


def register_keys(subparsers: argparse._SubParsersAction) -> None:
    """Adds ``keys``."""
    parser = subparsers.add_parser(
        "keys",
        help="make, list and revoke API keys",
        description="Keys of the service, in its database. A service that runs follows a change within some seconds.",
    )
    for name in ("data_dir", "database_url"):
        parser.add_argument(flag_of(name), dest=f"setting_{name}", metavar="VALUE", help=Settings.model_fields[name].description)
    parser.add_argument("--config", metavar="FILE", help="the TOML file of the service (environment: DDAKF_CONFIG)")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    create = actions.add_parser("create", help="make a key and print it, once")
    create.add_argument("name", help="whom or what it is for")
    create.add_argument(
        "--scope",
        action="append",
        choices=("stream", "read", "admin"),
        required=True,
        help="stream: sessions of its own; read: everyone's sessions and the metrics; admin: everything; may be repeated",
    )
    create.add_argument("--max-sessions", type=int, default=0, metavar="N", help="at a time; default: the service's setting")
    listing = actions.add_parser("list", help="show all keys, without their secrets")
    listing.add_argument("--json", action="store_true", help="as a JSON list")
    revoke = actions.add_parser("revoke", help="end a key")
    revoke.add_argument("id", help="as `list` shows it")
    parser.set_defaults(run=_keys)


def _keys(args: argparse.Namespace) -> int:
    from .trust.command import run

    return run(args)

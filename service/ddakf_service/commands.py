"""The command ``ddakf serve``; what it does is in ``serve.py``, which is imported only when it runs."""

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
        parser.add_argument(flag_of(name), dest=f"setting_{name}", metavar="VALUE", help=field.description)
    parser.set_defaults(run=_serve)


def _serve(args: argparse.Namespace) -> int:
    from .serve import serve  # gRPC and FastAPI would slow down every other command

    return serve(args)

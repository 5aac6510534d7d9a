"""Arguments of ``ddakf serve``: one flag per setting."""

from __future__ import annotations

import argparse

from ..setting_sources import flag_of
from ..settings import Settings


def add_serve_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of ``serve`` to a parser."""
    parser.add_argument("--config", metavar="FILE", help="a TOML file with settings (environment: DDAKF_CONFIG)")
    parser.add_argument("--print-config", action="store_true", help="show the settings and where each is from, and end")
    parser.add_argument("--json", action="store_true", help="progress, addresses and settings as JSON lines")
    parser.add_argument("--with-parent", action="store_true", help="stop when standard input closes")
    for name, field in Settings.model_fields.items():
        switch = {"nargs": "?", "const": "true"} if field.annotation is bool else {}
        parser.add_argument(flag_of(name), dest=f"setting_{name}", metavar="VALUE", help=field.description, **switch)

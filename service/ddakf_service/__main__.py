"""Main program ``python -m ddakf_service``, the same as ``ddakf serve``."""

import sys

from ddakf.commands.parser import Parser

from .commands.cli import run_serve
from .commands.serve_arguments import add_serve_arguments

if __name__ == "__main__":
    parser = Parser(prog="ddakf_service", description="Runs the ddakf service.")
    add_serve_arguments(parser)
    sys.exit(run_serve(parser.parse_args()))

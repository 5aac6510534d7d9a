"""Main program ``python -m ddakf_service``, the same as ``ddakf serve``."""

import argparse
import sys

from .commands.serve import serve
from .commands.serve_arguments import add_serve_arguments

if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="ddakf_service", description="Runs the ddakf service.")
    add_serve_arguments(parser)
    args = parser.parse_args()
    sys.exit(serve(args))

"""Calls of a server: what the commands share that talk to one."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable

from ddakf.commands.remote import server_options
from ddakf.errors import DdakfError

DEFAULT_SERVER = "127.0.0.1:7701"


def add_options(parser: argparse.ArgumentParser, *, repeated: bool = False, watching: str = "") -> None:
    """Adds the options of the connection, and ``--json``.

    Args:
        repeated: another parser of the same command has them with their defaults.
        watching: what its help says of results that arrive one by one.
    """
    server, credentials, in_json = (argparse.SUPPRESS,) * 3 if repeated else (DEFAULT_SERVER, None, False)
    meaning = f"gRPC address (default {DEFAULT_SERVER})"
    server_options.add(parser, server=server, meaning=meaning, default=credentials)
    parser.add_argument("--json", action="store_true", default=in_json, help="JSON instead of a table" + watching)


def connected(arguments: argparse.Namespace, run: Callable[..., None]) -> int:
    """Runs an action with a client; its errors become the command's."""
    from ddakf.evaluation.tracking.server import client_package

    package = client_package(f"`ddakf {arguments.command}`")
    try:
        with server_options.server_of(arguments).connect() as client:
            run(client, arguments)
    except package.errors.Unauthenticated as error:
        raise DdakfError(f"{error}; here --api-key KEY or the variable {server_options.KEY_VARIABLE}") from error
    except package.ServiceError as error:
        raise DdakfError(str(error)) from error
    return 0


def result_line(answer) -> str:
    """A result of a session, or a refused frame, as a line."""
    if hasattr(answer, "error"):
        return f"frame {answer.sequence:6d}  refused: {answer.error}"
    return (
        f"frame {answer.sequence:6d}  {answer.state:12s}  reliability {answer.reliability:.2f}  coverage {answer.coverage:.2f}"
        f"  server {1e3 * answer.timings.get('server', 0.0):.0f} ms  dropped {answer.dropped}"
    )


def print_json(value, indent: int | None = 2) -> None:
    """Prints at once, for those who read a pipe."""
    print(json.dumps(value, indent=indent), flush=True)

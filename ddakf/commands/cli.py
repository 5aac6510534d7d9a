"""The command line: one entry point; commands register through the entry-point group ``ddakf.commands``.

A command is a function ``register(subparsers)`` that adds a parser with ``set_defaults(run=function)``; the function
gets the parsed arguments and returns the exit status. Registering must be light: heavy imports belong into the
function.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata

import ddakf
from ddakf.commands import benchmark, doctor, evaluate, report, simulate, track
from ddakf.commands.parser import Parser
from ddakf.commands.remote import recordings, sessions
from ddakf.errors import SERVICE_PACKAGES, DdakfError

GROUP = "ddakf.commands"
FAILURE, INTERRUPTED = 2, 130
EXTRAS = {
    "matplotlib": "evaluation",
    "open3d": "evaluation",
    "scipy": "evaluation",
    "torch": "learned",
    "newton": "simulation",
    "warp": "simulation",
    "ray": "ray",
}  # otherwise those of the service


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        argv: arguments without the program's name; default those of the process.

    Returns:
        Exit status: 0 done, 2 an error that was explained in one sentence on stderr, 130 interrupted.
    """
    arguments = _parser().parse_args(argv)
    try:
        with _ended_in_order():
            return arguments.run(arguments) or 0
    except DdakfError as error:
        print(f"ddakf: {error}", file=sys.stderr)
        return FAILURE
    except BrokenPipeError:  # who reads the output has enough of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter flushes it at its end
        return FAILURE
    except OSError as error:  # a full disk, a folder without permission
        if error.strerror is None:
            raise
        print(f"ddakf: {f'{error.filename}: ' if error.filename else ''}{error.strerror}", file=sys.stderr)
        return FAILURE
    except ModuleNotFoundError as error:
        print(f"ddakf: {_what_to_install(arguments.command, error)}", file=sys.stderr)
        return FAILURE
    except Ended as signalled:
        return 128 + signalled.args[0]
    except KeyboardInterrupt:
        print("ddakf: interrupted", file=sys.stderr)
        return INTERRUPTED


class Ended(KeyboardInterrupt):
    """A signal other than Ctrl-C ended the command; its number is the argument."""


@contextmanager
def _ended_in_order() -> Iterator[None]:
    """SIGTERM and SIGHUP end a command as Ctrl-C does, so that it saves what it has, unless something else handles them."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread can set signal handlers
        yield
        return

    def end(number: int, _frame) -> None:
        raise Ended(number)

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    unhandled = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]  # nohup ignores SIGHUP
    for number in unhandled:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in unhandled:
            signal.signal(number, signal.SIG_DFL)


def _parser() -> Parser:
    parser = Parser(prog="ddakf", description="Real-time garment tracking from 3D point clouds.")
    parser.add_argument("--version", action="version", version=f"ddakf {ddakf.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    track.register(commands)
    evaluate.register(commands)
    report.register(commands)
    benchmark.register(commands)
    doctor.register(commands)
    simulate.register(commands)
    sessions.register(commands)
    recordings.register(commands)
    for entry_point in sorted(metadata.entry_points(group=GROUP), key=lambda e: e.name):
        if entry_point.name not in commands.choices:
            _load(entry_point)(commands)
    return parser


def _load(entry_point: metadata.EntryPoint) -> Callable[[argparse._SubParsersAction], None]:
    try:
        return entry_point.load()
    except ImportError as error:
        sentence = _what_to_install(entry_point.name, error)
    return lambda commands: _register_unavailable(commands, entry_point.name, sentence)


def _register_unavailable(commands: argparse._SubParsersAction, name: str, sentence: str) -> None:
    """A command whose package is absent still shows in the help, and says what it lacks."""

    def explain(arguments: argparse.Namespace) -> int:
        print(f"ddakf: {sentence}", file=sys.stderr)
        return FAILURE

    command = commands.add_parser(name, help=f"not available: {sentence}", add_help=False, prefix_chars="\0")
    command.add_argument("ignored", nargs="*")
    command.set_defaults(run=explain)


def _what_to_install(command: str, error: ImportError) -> str:
    missing = error.name or str(error)
    extra = "simulation" if command == "simulate" else EXTRAS.get(missing.partition(".")[0])
    how = f": pip install 'ddakf[{extra}]'" if extra else f"; {SERVICE_PACKAGES}"
    return f"{command} needs {missing}, which is not installed{how}"


if __name__ == "__main__":
    sys.exit(main())

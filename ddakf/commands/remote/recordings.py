"""``ddakf record`` and ``ddakf replay``: the frames and results of a session as MCAP, and their comparison with a new session."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import math
import sys
import time

from ddakf.commands.remote.calls import add_options, connected, print_json, result_line
from ddakf.commands.tables import print_table
from ddakf.errors import DdakfError, InvalidArgument

RECORD = "record a session's frames and results as MCAP, until Ctrl-C or its end"
REPLAY = "send a recording to a new session, and compare its results"
_PROGRESS_INTERVAL = 1.0  # seconds between two lines


def register(commands: argparse._SubParsersAction) -> None:
    """Adds both commands to the parser; ``ddakf sessions`` has them too."""
    for name, text, add_arguments, run in (
        ("record", RECORD, add_record_arguments, record),
        ("replay", REPLAY, add_replay_arguments, replay),
    ):
        parser = commands.add_parser(name, help=text)
        add_arguments(parser)
        add_options(parser)
        parser.set_defaults(run=lambda arguments, run=run: connected(arguments, run))


def add_record_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of :func:`record`."""
    parser.add_argument("id", help="id of the session, as `ddakf sessions list` shows it")
    parser.add_argument("file", metavar="FILE.mcap", help="recording to write, replaced if it exists; Foxglove opens it")
    parser.add_argument("--seconds", type=float, default=math.inf, metavar="S", help="stop after this many seconds")
    parser.add_argument("--frames", type=int, default=math.inf, metavar="N", help="stop after this many frames")


def add_replay_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of :func:`replay`."""
    parser.add_argument("file", metavar="FILE.mcap")


def record(client, arguments: argparse.Namespace) -> None:
    """Records a session, with a line per second."""
    session, package = client.open_session(arguments.id), _package()
    said, count = -_PROGRESS_INTERVAL, 0

    def show(result) -> None:
        nonlocal said, count
        count += 1
        if not arguments.json and time.monotonic() - said >= _PROGRESS_INTERVAL:
            said = time.monotonic()
            print(result_line(result), flush=True)

    try:
        recorded = package.record(session, arguments.file, seconds=arguments.seconds, frames=arguments.frames, on_result=show)
    except _failure():
        if count:
            print(f"{arguments.file}: {count} frames, then the recording ended early", file=sys.stderr)
        raise
    except OSError as error:  # that of a write has no name
        raise OSError(error.errno, error.strerror, error.filename or arguments.file) from None
    if arguments.json:
        print_json({"file": arguments.file, "frames": recorded.frames, "missing": recorded.missing})
    else:
        missing = f", {recorded.missing} in between are missing: this reader fell behind" if recorded.missing else ""
        print(f"{arguments.file}: {recorded.frames} frames{missing}")


def replay(client, arguments: argparse.Namespace) -> None:
    """Tracks the recorded frames again, and prints how far the results are from the recorded ones.

    A frame for which a server was short of time left work out, and one that is missing moved the garment: from there on the
    results may differ.
    """
    package = _package()
    try:
        recording = package.load(arguments.file)
    except OSError as error:
        raise InvalidArgument("file", "a recording", f"{arguments.file}: {error.strerror}") from None
    except _failure() as error:
        if getattr(error, "field", None) != "path":
            raise
        raise InvalidArgument("file", error.expected, error.got) from None
    count, in_full, short, missing, states, largest, largest_in_full, applied = 0, 0, 0, 0, 0, 0.0, 0.0, 0
    for before, now in package.replay(client, recording):
        missing += max(before.applied - applied - 1, 0) if count else 0
        count, applied = count + 1, before.applied
        short += any(result.usage.widening != 1 or result.usage.lighter for result in (before, now))
        states += before.state == now.state
        if len(before.vertices) and before.vertices.shape == now.vertices.shape:
            largest = max(largest, float(abs(before.vertices - now.vertices).max()))
        if not short and not missing:
            in_full, largest_in_full = in_full + 1, largest
    values = {"frames": count, "same state": states, "largest difference mm": 1e3 * largest}
    values |= {"short of time": short, "missing": missing}
    values |= {"frames before": in_full, "largest difference before mm": 1e3 * largest_in_full}
    if arguments.json:
        print_json({name.replace(" ", "_"): value for name, value in values.items()})
        return
    print_table(("figure", "value"), ((name, f"{value:g}") for name, value in values.items()))
    if short:
        print("Short of time: a server left work out of these frames; from the first of them on, results may differ.")
    if missing:
        print("Missing: the session tracked these frames, and they are not in the file; from there on, results differ.")
    if largest_in_full > 0:
        print("Differences before: the server has another version or processor.")


def _failure() -> type[Exception]:
    """What a call of a server, or a recording, raises."""
    from ddakf.evaluation.tracking.server import client_package

    return client_package("recordings").ServiceError


def _package():
    """The module of recordings. Raises DdakfError: mcap is not installed."""
    from ddakf.evaluation.tracking.server import client_package

    package = client_package("recordings")
    if importlib.util.find_spec("mcap") is None:
        raise DdakfError("recordings need mcap: pip install 'ddakf-client[recording]'")
    return importlib.import_module(f"{package.__name__}.recordings")

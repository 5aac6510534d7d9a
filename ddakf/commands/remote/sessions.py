"""``ddakf sessions``: lists, shows, watches, records and deletes the sessions of a server, and prints their history."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime

from rich.console import Console

from ddakf.commands.remote import recordings
from ddakf.commands.remote.calls import add_options, connected, print_json, result_line
from ddakf.commands.tables import print_table
from ddakf.errors import InvalidArgument

_WATCHING = "; a line per result of `watch`"
_NO_ARRAYS = 2**32 - 1  # only every n-th result has arrays
_PROGRESS_INTERVAL = 1.0  # seconds between two lines of a watcher
_CLOCK = 1e5  # seconds from which on a number is taken for a clock's
_SHOWN_SAMPLES = 40  # of a history, unless told otherwise


def register(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = commands.add_parser("sessions", help="list, show, watch, record and delete the sessions of a server")
    add_options(parser, watching=_WATCHING)
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    listing = _add(actions, "list", _list, "show all sessions that the key may read")
    listing.add_argument("--state", metavar="STATE", help="only sessions in this state: tracking, idle, lost, ...")
    listing.add_argument(
        "--label", action="append", default=[], metavar="KEY=VALUE", help="only sessions with this label; repeatable"
    )
    _add(actions, "get", _get, "show one session").add_argument("id")
    watching = _add(actions, "watch", _watch, "a line per second of a session's results, until Ctrl-C")
    watching.add_argument("id")
    _add(actions, "delete", _delete, "end sessions").add_argument("id", nargs="+")
    history = _add(actions, "history", _history, "reliability, latency and state over time, of a live or an ended session")
    history.add_argument("id")
    history.add_argument("--start", metavar="TIME", help="first time, ISO 8601 (default: the session's creation)")
    history.add_argument("--end", metavar="TIME", help="last time, ISO 8601 (default: now, or the session's end)")
    history.add_argument("--samples", type=int, default=_SHOWN_SAMPLES, metavar="N", help="at most this many lines (default 40)")
    recordings.add_record_arguments(_add(actions, "record", recordings.record, recordings.RECORD))
    recordings.add_replay_arguments(_add(actions, "replay", recordings.replay, recordings.REPLAY))


def _add(actions: argparse._SubParsersAction, name: str, run, text: str) -> argparse.ArgumentParser:
    parser = actions.add_parser(name, help=text)
    add_options(parser, repeated=True, watching=_WATCHING if name == "watch" else "")  # on either side of the action
    parser.set_defaults(run=lambda arguments: connected(arguments, run))
    return parser


def _list(client, arguments: argparse.Namespace) -> None:
    labels = dict(_key_value(text) for text in arguments.label)
    sessions = list(client.sessions(state=arguments.state, labels=labels))
    if arguments.json:
        print_json([{name: value for name, value in _values(session).items() if name != "config"} for session in sessions])
        return
    if not sessions:
        print("no session matches" if arguments.state or labels else "no live session that the key may read")
        return
    columns = ("id", "state", "frames", "per second", "reliability", "coverage", "latency ms", "dropped", "labels")
    print_table(columns, (_row(session) for session in sessions))


def _row(session) -> tuple[str, ...]:
    return (
        session.session_id,
        session.state,
        str(session.applied),
        f"{session.frame_rate:.1f}",
        f"{session.reliability:.2f}",
        f"{session.coverage:.2f}",
        f"{1e3 * session.last_latency:.0f}",
        str(session.dropped),
        _text(session.labels),
    )


def _get(client, arguments: argparse.Namespace) -> None:
    values = _values(client.open_session(arguments.id).info())
    if arguments.json:
        print_json(values)
        return
    values["config"] = f"{len(values['config'])} stages; --json shows them"
    print_table(("field", "value"), ((name, _text(value)) for name, value in values.items()))


def _text(value) -> str:
    """A field's value for people: KEY=VALUE in the order of the keys, numbers of six digits, clocks to a millisecond."""
    if isinstance(value, dict):
        return " ".join(f"{key}={_text(each)}" for key, each in sorted(value.items()))
    if isinstance(value, (list, tuple)):
        return "; ".join(_text(each) for each in value)
    if isinstance(value, float):
        return f"{value:.6g}" if abs(value) < _CLOCK else f"{value:.3f}"
    return "" if value is None else str(value)


def _watch(client, arguments: argparse.Namespace) -> None:
    said = -_PROGRESS_INTERVAL
    try:
        for answer in client.open_session(arguments.id).watch(every_nth=_NO_ARRAYS, on_notice=_print_notice):
            if arguments.json:
                print_json(_answer(answer), indent=None)
            elif hasattr(answer, "error") or time.monotonic() - said >= _PROGRESS_INTERVAL:
                said = time.monotonic()
                print(result_line(answer), flush=True)
    except KeyboardInterrupt:
        return


def _answer(answer) -> dict:
    """The numbers of a result, or a refused frame with its sentence."""
    if hasattr(answer, "error"):
        return {"sequence": answer.sequence, "error": str(answer.error)}
    numbers = {name: value for name, value in vars(answer).items() if isinstance(value, (int, float, str, dict))}
    del numbers["latency"]  # another client sent the frame
    return numbers


def _print_notice(notice) -> None:
    Console(stderr=True).print(f"{notice.kind}: {notice.message}", highlight=False, soft_wrap=True)


def _delete(client, arguments: argparse.Namespace) -> None:
    """Deletes the sessions that there are, whatever becomes of the others."""
    from ddakf.evaluation.tracking.server import client_package

    deleted, failures, failed = [], [], client_package("sessions delete").ServiceError
    for session_id in arguments.id:
        try:
            client.open_session(session_id).delete()
            deleted.append(session_id)
        except failed as error:
            failures.append(error)
    if arguments.json:
        print_json({"deleted": deleted})
    for error in failures[:-1]:
        print(f"ddakf: {error}", file=sys.stderr)
    if failures:
        raise failures[-1]


def _history(client, arguments: argparse.Namespace) -> None:
    span = {"start": _time("start", arguments.start), "end": _time("end", arguments.end)}
    history = client.history(arguments.id, **span, max_samples=arguments.samples)
    arrays = {name: value.tolist() for name, value in vars(history).items() if hasattr(value, "tolist")}
    changes = [{"time": change.time.isoformat(), "state": change.state} for change in history.states]
    if arguments.json:
        print_json({"name": history.name, "resolution": history.resolution, **arrays, "states": changes})
        return
    columns = ("start", "frames", "dropped", "late", "rejected", "reliability", "least", "coverage", "latency ms", "greatest")
    print_table(columns, _history_rows(arrays))
    for change in changes:
        print(f"{change['time']}  {change['state']}")


def _history_rows(arrays: dict[str, list]) -> Iterator[tuple[str, ...]]:
    counts = ("applied", "dropped", "late", "rejected")
    for i, start in enumerate(arrays["start"]):
        yield (
            datetime.fromtimestamp(start).astimezone().strftime("%Y-%m-%d %H:%M:%S"),
            *(str(arrays[name][i]) for name in counts),
            *(f"{arrays[name][i]:.2f}" for name in ("reliability", "least_reliability", "coverage")),
            *(f"{1e3 * arrays[name][i]:.0f}" for name in ("latency", "greatest_latency")),
        )


def _values(session) -> dict:
    """A session's fields, times as ISO 8601."""
    values = dataclasses.asdict(session) | {"limits": session.limits._asdict()}
    return {name: value.isoformat() if isinstance(value, datetime) else value for name, value in values.items()}


def _key_value(text: str) -> tuple[str, str]:
    key, separator, value = text.partition("=")
    if not separator:
        raise InvalidArgument("label", "KEY=VALUE", text)
    return key, value


def _time(name: str, text: str | None) -> datetime | None:
    if text is None:
        return None
    with contextlib.suppress(ValueError):
        return datetime.fromisoformat(text).astimezone()
    try:
        return datetime.fromtimestamp(float(text), UTC)
    except (ValueError, OverflowError, OSError):  # no number, or no time that there is
        raise InvalidArgument(name, "a time such as 2026-01-31T12:00:00, or seconds since 1970", text) from None

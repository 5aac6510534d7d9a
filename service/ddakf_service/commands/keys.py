"""Command ``ddakf keys``: creates, lists and revokes keys in the database, with or without a running service."""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import math
import os
import re
import sys
import time
from contextlib import closing
from datetime import datetime
from pathlib import Path

from ddakf_api.errors import ServiceError

from ddakf.commands.tables import print_table
from ddakf.errors import InvalidArgument, InvalidConfig

from ..auth.key_database import DatabaseKeyStore
from ..auth.keys import PREFIX, Key, KeyLimits, generate, utc
from ..auth.principal import Scope
from ..observability.metrics import Metrics
from ..setting_sources import load, unknown_variables
from ..settings import Settings
from ..store.files.data_folder import make_data_folder
from ..store.store import database_url, exposures
from ..store.tables.database import IN_MEMORY, Database

_LONGEST_NAME = 256
_DURATION = re.compile(r"([0-9]+(?:\.[0-9]+)?)([mhdw])")
_SECONDS = {"m": 60, "h": 3600, "d": 86_400, "w": 604_800}
_MAX_SESSIONS = 2**31 - 1  # of a column of the database
_GROUP_READS = 0o640


def run(args: argparse.Namespace) -> int:
    """Runs the command and returns the exit status."""
    flags = {name: value for name in ("data_dir", "database_url") if (value := getattr(args, f"setting_{name}")) is not None}
    settings = load(flags, args.config)[0]
    _check(args)
    url = database_url(settings)
    if url == IN_MEMORY:
        raise InvalidConfig("data_dir", "a folder, or a database_url, to store keys", "none")
    database = Database(url, Metrics())
    _require_file(database.file, settings, may_be_new=args.action == "create")
    logging.getLogger("ddakf_service").addHandler(logging.NullHandler())  # the error that follows has the reason
    database.open(upgrade=False)
    for sentence in (*unknown_variables(), *exposures(settings, database)):
        print(f"ddakf keys: {sentence}", file=sys.stderr)
    with closing(database):
        try:
            return _ACTIONS[args.action](DatabaseKeyStore(database), args)
        except ServiceError as error:
            print(f"ddakf keys: {error}", file=sys.stderr)
            return 1


def _require_file(file: Path | None, settings: Settings, *, may_be_new: bool) -> None:
    """Refuses a mistyped place: an empty database would have no keys to list, and a key in it would open no service.

    Args:
        file: of a SQLite database; None: PostgreSQL.
        may_be_new: a new file is made, in an existing folder or in the data folder.

    Raises:
        InvalidConfig
    """
    if file is None or file.exists():
        return
    setting = "database_url" if settings.database_url else "data_dir"
    if not may_be_new:
        raise InvalidConfig(setting, "the database of a service", f"{file}, which does not exist")
    if not settings.database_url:
        make_data_folder(file.parent)
    elif not file.parent.is_dir():
        raise InvalidConfig(setting, "a file in a folder that exists", str(file))
    print(f"ddakf keys: {file} did not exist and is made", file=sys.stderr)


def _check(args: argparse.Namespace) -> None:
    """Refuses invalid arguments before a database is made."""
    if args.action != "create":
        return
    if not 0 < len(args.name) <= _LONGEST_NAME:
        raise InvalidArgument("name", f"1 to {_LONGEST_NAME} characters", str(len(args.name)))
    if not 0 <= args.max_sessions <= _MAX_SESSIONS:
        raise InvalidArgument("max_sessions", f"a number from 0 to {_MAX_SESSIONS}", str(args.max_sessions))
    for name in ("frames_per_second", "requests_per_minute"):
        if not 0 <= (rate := getattr(args, name)) < math.inf:
            raise InvalidArgument(name, "a number from 0", f"{rate:g}")
    if args.expires is not None:
        _expiry(args.expires)


def _expiry(text: str) -> float:
    """The time of an expiry, seconds since 1970, from a duration such as "30d" or a time of ISO 8601."""
    expected = "a number of m, h, d or w, as in 30d, or a time in the future, as in 2030-01-31T12:00"
    try:
        if matched := _DURATION.fullmatch(text):
            at = time.time() + float(matched[1]) * _SECONDS[matched[2]]
        else:
            at = datetime.fromisoformat(text).astimezone().timestamp()
        utc(at)  # within the calendar
    except (ValueError, OverflowError):
        raise InvalidArgument("expires", expected, repr(text[:40])) from None
    if at <= time.time():
        raise InvalidArgument("expires", expected, repr(text[:40]))
    return at


def _create(keys: DatabaseKeyStore, args: argparse.Namespace) -> int:
    if args.file is not None and _is_in_force(keys, args.file):
        print(f"ddakf keys: {args.file} has a key in force", file=sys.stderr)
        return 0
    expires = None if args.expires is None else _expiry(args.expires)
    limits = KeyLimits(args.max_sessions, args.frames_per_second, args.requests_per_minute, expires)
    key, shown = generate(args.name, [Scope(scope) for scope in args.scope], time.time(), limits)
    if args.file is not None:
        _write(args.file, shown)
        keys.add(key)
        print(f"ddakf keys: {args.file} has the key of {args.name!r}", file=sys.stderr)
        return 0
    keys.add(key)
    print(f"key of {args.name!r}, shown this once:", file=sys.stderr)
    print(shown)
    return 0


def _is_in_force(keys: DatabaseKeyStore, file: Path) -> bool:
    """Whether a file holds a key that is neither revoked nor expired."""
    try:
        presented = file.read_text(encoding="utf-8", errors="replace").strip()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise InvalidArgument("file", "a file that can be read", f"{file}: {error.strerror}") from None
    return any(key.revoked is None and not key.has_expired() and key.matches(presented) for key in keys.all())


def _write(file: Path, key: str) -> None:
    """Writes a key for its owner and group; a file that exists is replaced."""
    try:
        with contextlib.suppress(FileNotFoundError):
            file.unlink()
        with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _GROUP_READS), "w", encoding="utf-8") as out:
            os.fchmod(out.fileno(), _GROUP_READS)
            out.write(key + "\n")
    except OSError as error:
        raise InvalidArgument("file", "a file that can be written", f"{file}: {error.strerror}") from None


def _list(keys: DatabaseKeyStore, args: argparse.Namespace) -> int:
    rows = [_row(key) for key in keys.all()]
    if args.json:
        sys.stdout.write(json.dumps(rows, indent=2) + "\n")
        return 0
    columns = ("id", "name", "scopes", "sessions", "frames/s", "requests/min", "created", "expires", "revoked")
    texts = ((" ".join(value) if isinstance(value, list) else str(value or "") for value in row.values()) for row in rows)
    print_table(columns, texts)
    return 0


def _revoke(keys: DatabaseKeyStore, args: argparse.Namespace) -> int:
    key_id = args.id.removeprefix(f"{PREFIX}_").partition("_")[0]
    if not keys.revoke(key_id, time.time()):
        raise InvalidArgument("id", "that of a key in force, as `ddakf keys list` shows it", repr(key_id[:40]))
    return 0


_ACTIONS = {"create": _create, "list": _list, "revoke": _revoke}


def _row(key: Key) -> dict:
    return {
        "id": key.id,
        "name": key.name,
        "scopes": sorted(key.scopes),
        "max_sessions": key.limits.max_sessions,
        "frames_per_second": key.limits.frames_per_second,
        "requests_per_minute": key.limits.requests_per_minute,
        "created": utc(key.created),
        "expires": None if key.limits.expires is None else utc(key.limits.expires),
        "revoked": None if key.revoked is None else utc(key.revoked),
    }

"""Command ``ddakf keys``: creates, lists and revokes keys in the database, with or without a running service."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from ddakf_api.errors import ServiceError
from rich.console import Console
from rich.table import Table

from ddakf.errors import InvalidArgument, InvalidConfig

from ..auth.key_database import DatabaseKeyStore
from ..auth.keys import PREFIX, Key, generate
from ..auth.principal import Scope
from ..observability.metrics import Metrics
from ..settings import load
from ..store.data_folder import make_folder
from ..store.database import IN_MEMORY, Database
from ..store.store import database_url

_LONGEST_NAME = 256


def run(args: argparse.Namespace) -> int:
    """Runs the command and returns the exit status."""
    flags = {name: value for name in ("data_dir", "database_url") if (value := getattr(args, f"setting_{name}")) is not None}
    settings = load(flags, args.config)[0]
    url = database_url(settings)
    if url == IN_MEMORY:
        raise InvalidConfig("data_dir", "a folder, or a database_url, to store keys", "none")
    if not settings.database_url:
        make_folder(Path(settings.data_dir).expanduser())
    database = Database(url, Metrics())
    database.open()
    with closing(database):
        try:
            return _ACTIONS[args.action](DatabaseKeyStore(database), args)
        except ServiceError as error:
            print(f"ddakf keys: {error}", file=sys.stderr)
            return 1


def _create(keys: DatabaseKeyStore, args: argparse.Namespace) -> int:
    if not 0 < len(args.name) <= _LONGEST_NAME:
        raise InvalidArgument("name", f"1 to {_LONGEST_NAME} characters", str(len(args.name)))
    if args.max_sessions < 0:
        raise InvalidArgument("max_sessions", "a number from 0", str(args.max_sessions))
    key, shown = generate(args.name, [Scope(scope) for scope in args.scope], time.time(), args.max_sessions)
    keys.add(key)
    print(f"key of {args.name!r}, shown this once:", file=sys.stderr)
    print(shown)
    return 0


def _list(keys: DatabaseKeyStore, args: argparse.Namespace) -> int:
    rows = [_row(key) for key in keys.all()]
    if args.json:
        sys.stdout.write(json.dumps(rows, indent=2) + "\n")
        return 0
    table = Table("id", "name", "scopes", "sessions", "created", "revoked", box=None, header_style="bold")
    for row in rows:
        table.add_row(*(" ".join(value) if isinstance(value, list) else str(value or "") for value in row.values()))
    Console(highlight=False).print(table)
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
        "max_sessions": key.max_sessions,
        "created": _time(key.created),
        "revoked": None if key.revoked is None else _time(key.revoked),
    }


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")

"""Temporary PostgreSQL for tests and the chaos test: Debian's binaries, a temporary folder, a free loopback port."""

from __future__ import annotations

import importlib.util
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

_FOLDERS = [*sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True), Path("/usr/local/bin"), Path("/usr/bin")]
_PATIENCE = 30.0  # seconds for a start or a stop


class NoPostgres(Exception):
    """PostgreSQL cannot run on this machine; the message has the reason."""


class Postgres:
    """A cluster; ``start`` and ``stop`` as often as wanted, ``remove`` at the end.

    Raises:
        NoPostgres: it is not installed, or there is no user who may run it.
    """

    def __init__(self):
        self._bin = next((f for f in _FOLDERS if (f / "initdb").exists() and (f / "postgres").exists()), None)
        if self._bin is None:
            raise NoPostgres("PostgreSQL is not installed here")
        if importlib.util.find_spec("psycopg") is None:
            raise NoPostgres("psycopg is not installed, the driver of PostgreSQL")
        self._user = _not_root() if os.geteuid() == 0 else {}
        # Of its own, for a folder of pytest's may be entered by this user alone, and PostgreSQL refuses to run as root.
        self._folder = Path(tempfile.mkdtemp(prefix="ddakf-postgres-"))
        if self._user:
            os.chown(self._folder, self._user["user"], self._user["group"])
        self._process: subprocess.Popen | None = None
        with socket.create_server(("127.0.0.1", 0)) as free:
            self._port = free.getsockname()[1]
        arguments = ["-D", "data", "-U", "ddakf", "-A", "trust", "-E", "UTF8", "--no-locale", "--no-sync"]
        subprocess.run([self._bin / "initdb", *arguments], cwd=self._folder, check=True, capture_output=True, **self._user)

    @property
    def url(self) -> str:
        """URL of the database that every cluster has."""
        return self._url("postgres")

    def new_database(self, name: str) -> str:
        """The URL of an empty database."""
        import psycopg

        with psycopg.connect(host="127.0.0.1", port=self._port, user="ddakf", dbname="postgres", autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{name}"')
        return self._url(name)

    def start(self) -> None:
        options = ("listen_addresses=127.0.0.1", "unix_socket_directories=", f"port={self._port}", "fsync=off")
        arguments = [part for option in options for part in ("-c", option)]
        self._process = subprocess.Popen(
            [self._bin / "postgres", "-D", "data", *arguments], cwd=self._folder, stderr=subprocess.DEVNULL, **self._user
        )
        deadline = time.monotonic() + _PATIENCE
        ask = [self._bin / "pg_isready", "-q", "-h", "127.0.0.1", "-p", str(self._port)]
        while subprocess.run(ask).returncode:
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError("PostgreSQL did not start")
            time.sleep(0.05)

    def stop(self) -> None:
        """Stops at once and cuts the connections."""
        if self._process is not None:
            self._process.send_signal(signal.SIGQUIT)
            self._process.wait(_PATIENCE)
            self._process = None

    def remove(self) -> None:
        self.stop()
        shutil.rmtree(self._folder)

    def _url(self, database: str) -> str:
        return f"postgresql+psycopg://ddakf@127.0.0.1:{self._port}/{database}"


def _not_root() -> dict:
    """Arguments of a subprocess that another user runs."""
    for name in ("postgres", "nobody"):
        try:
            other = pwd.getpwnam(name)
        except KeyError:
            continue
        return {"user": other.pw_uid, "group": other.pw_gid, "extra_groups": []}
    raise NoPostgres("there is no user but root to run PostgreSQL as")

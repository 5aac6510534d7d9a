"""A PostgreSQL of one's own: Debian's binaries, a cluster in a temporary folder, a free loopback port."""

from __future__ import annotations

import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

import pytest

_FOLDERS = [*sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True), Path("/usr/local/bin"), Path("/usr/bin")]
_PATIENCE = 30.0  # seconds for a start or a stop


class Postgres:
    """A cluster; ``start`` and ``stop`` as often as wanted, ``remove`` at the end."""

    def __init__(self):
        self._bin = next((f for f in _FOLDERS if (f / "initdb").exists() and (f / "postgres").exists()), None)
        if self._bin is None:
            pytest.skip("PostgreSQL is not installed here")
        # Not pytest's folder, which only this user may enter: PostgreSQL refuses to run as root.
        self._folder = Path(tempfile.mkdtemp(prefix="ddakf-postgres-"))
        self._user = {}
        if os.geteuid() == 0:
            other = _other_user()
            os.chown(self._folder, other.pw_uid, other.pw_gid)
            self._user = {"user": other.pw_uid, "group": other.pw_gid, "extra_groups": []}
        self._process: subprocess.Popen | None = None
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self._run("initdb", "-D", "data", "-U", "ddakf", "-A", "trust", "-E", "UTF8", "--no-locale", "--no-sync")

    @property
    def url(self) -> str:
        return f"postgresql+psycopg://ddakf@127.0.0.1:{self.port}/postgres"

    def start(self) -> None:
        options = ("listen_addresses=127.0.0.1", "unix_socket_directories=", f"port={self.port}", "fsync=off")
        arguments = [part for option in options for part in ("-c", option)]
        self._process = subprocess.Popen(
            [self._bin / "postgres", "-D", "data", *arguments], cwd=self._folder, stderr=subprocess.DEVNULL, **self._user
        )
        deadline = time.monotonic() + _PATIENCE
        ask = [self._bin / "pg_isready", "-q", "-h", "127.0.0.1", "-p", str(self.port)]
        while subprocess.run(ask).returncode:
            assert self._process.poll() is None, "PostgreSQL ended instead of starting"
            assert time.monotonic() < deadline, "PostgreSQL did not start"
            time.sleep(0.05)

    def stop(self) -> None:
        """At once: connections are cut."""
        if self._process is not None:
            self._process.send_signal(signal.SIGQUIT)
            self._process.wait(_PATIENCE)
            self._process = None

    def _run(self, program: str, *arguments: str) -> None:
        subprocess.run([self._bin / program, *arguments], cwd=self._folder, check=True, capture_output=True, **self._user)

    def remove(self) -> None:
        self.stop()
        shutil.rmtree(self._folder)


def _other_user() -> pwd.struct_passwd:
    for name in ("postgres", "nobody"):
        try:
            return pwd.getpwnam(name)
        except KeyError:
            continue
    pytest.skip("there is no user but root to run PostgreSQL as")


def new_database(postgres: Postgres, name: str) -> str:
    """The URL of an empty database."""
    psycopg = pytest.importorskip("psycopg")
    with psycopg.connect(host="127.0.0.1", port=postgres.port, user="ddakf", dbname="postgres", autocommit=True) as connection:
        connection.execute(f'CREATE DATABASE "{name}"')
    return postgres.url.rpartition("/")[0] + f"/{name}"

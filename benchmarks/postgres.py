"""Temporary PostgreSQL for tests and the chaos test: Debian's binaries, a temporary folder, a loopback port that stays free."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from ports import lasting_port

_FOLDERS = [*sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True), Path("/usr/local/bin"), Path("/usr/bin")]
_PATIENCE = 30.0  # seconds for a start or a stop


class NoPostgres(Exception):
    """PostgreSQL cannot run on this machine; the message has the reason."""


class PostgresFailed(RuntimeError):
    """PostgreSQL did not start or stop; the message has the end of its log."""


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
        user = _not_root() if os.geteuid() == 0 else None
        # setpriv becomes PostgreSQL. Popen itself would fork to change the user, which the threads of gRPC forbid.
        self._as_user = [] if user is None else ["setpriv", f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}", "--clear-groups"]
        # Of its own, for a folder of pytest's may be entered by this user alone, and PostgreSQL refuses to run as root.
        self._folder = Path(tempfile.mkdtemp(prefix="ddakf-postgres-"))
        if user is not None:
            os.chown(self._folder, user.pw_uid, user.pw_gid)
        self._process: subprocess.Popen | None = None
        self._port = lasting_port()
        arguments = ["-D", "data", "-U", "ddakf", "-A", "trust", "-E", "UTF8", "--no-locale", "--no-sync"]
        subprocess.run([*self._as_user, self._bin / "initdb", *arguments], cwd=self._folder, check=True, capture_output=True)

    @property
    def programs(self) -> Path:
        """The folder of its programs: pg_dump and others."""
        return self._bin

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
        """Returns when it accepts connections.

        Raises:
            PostgresFailed
        """
        options = ("listen_addresses=127.0.0.1", "unix_socket_directories=", f"port={self._port}", "fsync=off")
        arguments = [part for option in options for part in ("-c", option)]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [*self._as_user, self._bin / "postgres", "-D", "data", *arguments], cwd=self._folder, stderr=log
            )
        deadline = time.monotonic() + _PATIENCE
        ask = [self._bin / "pg_isready", "-q", "-h", "127.0.0.1", "-p", str(self._port)]
        answered = False
        while not answered:
            answered = subprocess.run(ask).returncode == 0
            if (status := self._process.poll()) is not None:
                raise self._failed(f"ended with status {status} at its start")
            if time.monotonic() > deadline:
                raise self._failed(f"accepted no connection for {_PATIENCE:g} s")
            time.sleep(0.0 if answered else 0.05)

    def stop(self) -> None:
        """Stops at once and cuts the connections.

        Raises:
            PostgresFailed
        """
        if self._process is not None:
            self._process.send_signal(signal.SIGQUIT)
            try:
                self._process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                raise self._failed(f"did not stop in {_PATIENCE:g} s") from None
            self._process = None

    def remove(self) -> None:
        self.stop()
        shutil.rmtree(self._folder)

    @property
    def _log(self) -> Path:
        return self._folder / "log"

    def _failed(self, what: str) -> PostgresFailed:
        last = self._log.read_text(errors="replace").strip().splitlines()[-3:]
        return PostgresFailed(f"PostgreSQL {what}: {' / '.join(last) or 'its log is empty'}")

    def _url(self, database: str) -> str:
        return f"postgresql+psycopg://ddakf@127.0.0.1:{self._port}/{database}"


def _not_root() -> pwd.struct_passwd:
    """Another user than root."""
    if shutil.which("setpriv") is None:
        raise NoPostgres("setpriv is not installed, and PostgreSQL refuses to run as root")
    for name in ("postgres", "nobody"):
        with contextlib.suppress(KeyError):
            return pwd.getpwnam(name)
    raise NoPostgres("there is no user but root to run PostgreSQL as")

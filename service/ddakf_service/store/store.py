"""Store of a server: database, registry, history and checkpoints, with locks against a second server."""

from __future__ import annotations

import re
from pathlib import Path

import sqlalchemy as sa
from ddakf_api.errors import Unavailable

from ddakf.errors import InvalidConfig

from ..observability.metrics import Metrics
from ..settings import Settings
from .checkpoints import Checkpoints
from .data_folder import DataFolder, Lock
from .database import IN_MEMORY, Database
from .history import History
from .registry import Registry
from .server_name import ServerName

NO_DATA_DIR = "none"  # data_dir of a server without durable state
_DAY = 86400.0
_IN_MEMORY_RETENTION = 3600.0  # seconds of history and of ended sessions that stay in memory
_RETRY_AFTER = 1.0  # seconds


class Store:
    """The durable state of a server; without a ``data_dir`` the same in memory, bounded.

    The constructor blocks and must not run in the event loop. Other methods block only where their docstring says so.

    Attributes:
        server_id: from the settings.
        registry, history, database: always present.
        checkpoints: None without ``data_dir`` and ``checkpoint_url``.

    Raises:
        InvalidConfig: with the setting's name. Another server uses the ``data_dir``, the SQLite file, the checkpoint folder
            or, in PostgreSQL, the ``server_id``; a place is not writable; a URL is invalid.
    """

    def __init__(self, settings: Settings, metrics: Metrics):
        self.server_id = settings.server_id
        self._name: ServerName | None = None
        self._locks: list[DataFolder | Lock] = []
        if settings.data_dir != NO_DATA_DIR:
            self._locks.append(DataFolder(Path(settings.data_dir).expanduser()))
        try:
            self.database = Database(database_url(settings), metrics)
            retention = _IN_MEMORY_RETENTION if self.database.in_memory else settings.history_days * _DAY
            self.registry = Registry(self.database, retention)
            self.history = History(self.database, retention)
            url = _checkpoint_url(settings)
            folder = re.sub(r"[^\w.-]", "_", settings.server_id).lstrip(".") or "_"
            self.checkpoints = Checkpoints(url, folder, settings.checkpoint_keep, metrics) if url else None
            self._take_files()
            self.database.open()
            self._take_name()
        except BaseException:
            self._release()
            raise
        if self.checkpoints is not None:
            self.checkpoints.open()

    def problems(self) -> list[str]:
        """One sentence for each failing part."""
        components = [self.database, *([self.checkpoints] if self.checkpoints is not None else [])]
        problems = [component.condition.problem for component in components]
        return [problem for problem in (*problems, self._name.problem if self._name else "") if problem]

    def require_name(self) -> None:
        """Checks that this server holds its name.

        Raises:
            Unavailable: another server of the same name may have its sessions.
        """
        if self._name is not None and self._name.problem:
            raise Unavailable(f"{self._name.problem}; try again later", retry_after=_RETRY_AFTER)

    def close(self) -> None:
        """Writes queued rows and checkpoints within some seconds and releases the locks; blocks."""
        self.history.close_all()
        if self.checkpoints is not None:
            self.checkpoints.close()
        self.database.close()
        if self._name is not None:
            self._name.release()
        self._release()

    def _take_files(self) -> None:
        """Locks files outside ``data_dir``: a second server on them would end this one's sessions and delete its checkpoints."""
        if (file := self.database.file) is not None:
            self._lock(file, "database_url")
        if self.checkpoints is not None and (folder := self.checkpoints.folder) is not None:
            self._lock(folder, "checkpoint_url")

    def _lock(self, path: Path, setting: str) -> None:
        path = path.resolve()
        try:
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._locks.append(Lock(path.with_name(path.name + ".lock"), setting, str(path)))
        except OSError as error:
            raise InvalidConfig(setting, "a place that can be written", f"{path}: {error.strerror}") from None

    def _take_name(self) -> None:
        """Takes the server's name in PostgreSQL, where it must be unique. A SQLite file belongs to one server anyway."""
        if engine := self.database.lasting_connections():
            name = ServerName(engine, self.server_id)
            try:
                name.take()
            except BaseException:
                self.database.close()
                raise
            self._name = name

    def _release(self) -> None:
        for lock in self._locks:
            lock.release()


def database_url(settings: Settings) -> str:
    """URL of the database with the registry, the history and the keys."""
    if settings.database_url or settings.data_dir == NO_DATA_DIR:
        return settings.database_url or IN_MEMORY
    path = Path(settings.data_dir).expanduser() / "ddakf.sqlite"
    return sa.URL.create("sqlite", database=str(path)).render_as_string()


def _checkpoint_url(settings: Settings) -> str:
    if settings.checkpoint_url or settings.data_dir == NO_DATA_DIR:
        return settings.checkpoint_url
    return str(Path(settings.data_dir).expanduser().absolute() / "checkpoints")

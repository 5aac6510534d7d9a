"""What outlives the process: the register of sessions and their history in a database, checkpoints in files or objects."""

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

NOTHING = "none"  # data_dir of a server that keeps nothing
_DAY = 86400.0
_KEPT_IN_MEMORY = 3600.0  # seconds of history and of ended sessions, where there is no place for more
_RETRY_AFTER = 1.0  # seconds


class Store:
    """All that is durable of a server; without a ``data_dir`` the same in memory, bounded.

    The thread that makes it may block, so not the event loop's. The parts never block but where they say so.

    Attributes:
        server_id: of the settings.
        registry, history, database: always there.
        checkpoints: None where there is neither a ``data_dir`` nor a ``checkpoint_url``.

    Raises:
        InvalidConfig: naming the setting: ``data_dir``, an SQLite, a folder of checkpoints or, in a PostgreSQL, ``server_id``
            is another server's; one cannot be written; a URL cannot be used.
    """

    def __init__(self, settings: Settings, metrics: Metrics):
        self.server_id = settings.server_id
        self._name: ServerName | None = None
        self._locks: list[DataFolder | Lock] = []
        if settings.data_dir != NOTHING:
            self._locks.append(DataFolder(Path(settings.data_dir).expanduser()))
        try:
            self.database = Database(database_url(settings), metrics)
            keep = _KEPT_IN_MEMORY if self.database.in_memory else settings.history_days * _DAY
            self.registry = Registry(self.database, keep)
            self.history = History(self.database, keep)
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
        """One sentence for each part that does not work now."""
        parts = [self.database, *([self.checkpoints] if self.checkpoints is not None else [])]
        problems = [part.condition.problem for part in parts]
        return [problem for problem in (*problems, self._name.problem if self._name else "") if problem]

    def require_name(self) -> None:
        """Raises :class:`Unavailable` while another server may have the sessions of this one's name."""
        if self._name is not None and self._name.problem:
            raise Unavailable(f"{self._name.problem}; try again later", retry_after=_RETRY_AFTER)

    def close(self) -> None:
        """Writes what waits, as far as that works within some seconds, and lets go of the folder; blocks."""
        self.history.close_all()
        if self.checkpoints is not None:
            self.checkpoints.close()
        self.database.close()
        if self._name is not None:
            self._name.release()
        self._release()

    def _take_files(self) -> None:
        """They may lie outside ``data_dir``, where another server would end this one's sessions and delete its checkpoints."""
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
        """Of the servers of one PostgreSQL one alone has a name; an SQLite is one server's with its file."""
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
    """Where the registry, the history and the keys are."""
    if settings.database_url or settings.data_dir == NOTHING:
        return settings.database_url or IN_MEMORY
    path = Path(settings.data_dir).expanduser() / "ddakf.sqlite"
    return sa.URL.create("sqlite", database=str(path)).render_as_string()


def _checkpoint_url(settings: Settings) -> str:
    if settings.checkpoint_url or settings.data_dir == NOTHING:
        return settings.checkpoint_url
    return str(Path(settings.data_dir).expanduser().absolute() / "checkpoints")

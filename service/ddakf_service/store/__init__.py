"""What outlives the process: the register of sessions and their history in a database, checkpoints in files or objects."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import sqlalchemy as sa

from .checkpoints import Checkpoints
from .database import IN_MEMORY, Database
from .folder import DataFolder
from .history import History
from .registry import Registry, SessionRecord, new_uid

if TYPE_CHECKING:
    from ..settings import Settings
    from ..telemetry import Metrics

__all__ = ["Checkpoints", "Database", "History", "Registry", "SessionRecord", "Store", "database_url", "new_uid"]

NOTHING = "none"  # data_dir of a server that keeps nothing
_DAY = 86400.0
_KEPT_IN_MEMORY = 3600.0  # seconds of history and of ended sessions, where there is no place for more


class Store:
    """All that is durable of a server; without a ``data_dir`` the same in memory, bounded.

    The thread that makes it may block, so not the event loop's. The parts never block but where they say so.

    Attributes:
        server_id: of the settings.
        registry, history, database: always there.
        checkpoints: None where there is neither a ``data_dir`` nor a ``checkpoint_url``.

    Raises:
        InvalidConfig: naming the setting: ``data_dir`` is another server's or cannot be written; a URL cannot be used.
    """

    def __init__(self, settings: Settings, metrics: Metrics):
        self.server_id = settings.server_id
        self._folder = None if settings.data_dir == NOTHING else DataFolder(Path(settings.data_dir).expanduser())
        try:
            self.database = Database(database_url(settings), metrics)
            keep = _KEPT_IN_MEMORY if self.database.in_memory else settings.history_days * _DAY
            self.registry = Registry(self.database, keep)
            self.history = History(self.database, keep)
            url = _checkpoint_url(settings)
            folder = re.sub(r"[^\w.-]", "_", settings.server_id).lstrip(".") or "_"
            self.checkpoints = Checkpoints(url, folder, settings.checkpoint_keep, metrics) if url else None
            self.database.open()
        except BaseException:
            self._release()
            raise
        if self.checkpoints is not None:
            self.checkpoints.open()

    def problems(self) -> list[str]:
        """One sentence for each part that does not work now."""
        parts = [self.database, *([self.checkpoints] if self.checkpoints is not None else [])]
        return [part.condition.problem for part in parts if part.condition.problem]

    def close(self) -> None:
        """Writes what waits, as far as that works within some seconds, and lets go of the folder; blocks."""
        self.history.close_all()
        if self.checkpoints is not None:
            self.checkpoints.close()
        self.database.close()
        self._release()

    def _release(self) -> None:
        if self._folder is not None:
            self._folder.release()


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

"""Store of a server: database, registry, history and checkpoints, with locks against a second server."""

from __future__ import annotations

import asyncio
import logging
import math
import re
import shutil
import threading
import uuid
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import sqlalchemy as sa
from ddakf_api.errors import Unavailable

from ddakf.errors import InvalidConfig

from ..observability.metrics import Metrics
from ..settings import Settings
from .files.checkpoints import Checkpoints
from .files.data_folder import DataFolder, Lock
from .files.permissions import FILE, FOLDER, exposure, make_folder
from .meshes import MeshStore
from .tables.database import IN_MEMORY, Database
from .tables.heartbeat import Beat, Heartbeat
from .tables.history import History
from .tables.leases import Leases
from .tables.registry import Registry
from .tables.server_name import SERVER_ID, ServerName

log = logging.getLogger(__name__)

_SHARED = ".sessions"  # folder of shared checkpoints; no server's own folder begins with a dot
NO_DATA_DIR = "none"  # data_dir of a server without durable state
_DAY = 86400.0
_IN_MEMORY_RETENTION = 3600.0  # seconds of history and of ended sessions that stay in memory
_RETRY_AFTER = 1.0  # seconds
_MEASURING = 1.0  # seconds that the answer of a disk is waited for


class Store:
    """The durable state of a server; without a ``data_dir`` the same in memory, bounded.

    The constructor blocks and must not run in the event loop. Other methods block only where their docstring says so.

    Attributes:
        server_id: from the settings.
        registry, history, database, meshes: always present.
        checkpoints: None without ``data_dir`` and ``checkpoint_url``.
        leases: of shared sessions; None: this server shares none.
        ready: whether this server takes sessions, for the others; called in another thread.

    Raises:
        InvalidConfig: with the setting's name. Another server uses the ``data_dir``, the SQLite file, the checkpoint folder
            or, in PostgreSQL, the ``server_id``; a place is not writable; a URL is invalid.
    """

    def __init__(self, settings: Settings, metrics: Metrics):
        self._settings, self.server_id = settings, settings.server_id
        self._heartbeat: Heartbeat | None = None
        self._measuring: Future[float] | None = None
        self.ready: Callable[[], bool] = lambda: True
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
            self.leases = Leases(self.database, settings.server_id) if settings.share_sessions else None
            folder = _SHARED if self.leases else re.sub(r"[^\w.-]", "_", settings.server_id).lstrip(".") or "_"
            self.checkpoints = Checkpoints(url, folder, settings.checkpoint_keep, metrics) if url else None
            self.meshes = MeshStore(self.database, _mesh_url(settings))
            self._take_files()
            self.database.open()
            self._take_name(metrics)
            for sentence in exposures(settings, self.database, self.checkpoints):
                log.warning(sentence)
        except BaseException:
            self._release()
            raise
        if self.checkpoints is not None:
            self.checkpoints.open()

    async def measure(self, metrics: Metrics) -> None:
        """Measures the room on the disk of the ``data_dir``; a disk that does not answer holds nothing else up."""
        if self._settings.data_dir == NO_DATA_DIR:
            return
        if self._measuring is None or self._measuring.done():
            self._measuring = now = Future()
            folder = Path(self._settings.data_dir).expanduser()
            threading.Thread(target=lambda: now.set_result(_free_bytes(folder)), name="disk", daemon=True).start()
        await asyncio.wait([asyncio.wrap_future(self._measuring)], timeout=_MEASURING)
        metrics.store_free.set(self._measuring.result() if self._measuring.done() else math.nan)

    def problems(self) -> dict[str, str]:
        """One sentence for each failing part, by its name."""
        conditions = [part.condition for part in (self.database, self.checkpoints) if part is not None]
        problems = {condition.part: condition.problem for condition in conditions}
        problems[SERVER_ID] = self._name.problem if self._name else ""
        return {part: problem for part, problem in problems.items() if problem}

    def require_name(self) -> None:
        """Checks that this server holds its name.

        Raises:
            Unavailable: another server of the same name may have its sessions.
        """
        if self._name is not None and self._name.problem:
            raise Unavailable(f"{self._name.problem}; try again later", retry_after=_RETRY_AFTER)

    def start_heartbeat(self, on_beat: Callable[[Beat], None]) -> None:
        """Begins to renew the leases.

        Args:
            on_beat: called in a thread of its own.
        """
        s, engine = self._settings, self.database.lasting_connections()
        holds_name = lambda: not self._name.problem  # noqa: E731
        self._heartbeat = Heartbeat(engine, s.server_id, s.gateway_address, s.lease_seconds, holds_name, on_beat)
        self._heartbeat.ready = self.ready
        self._heartbeat.start()

    def announce_readiness(self) -> None:
        """Tells other servers soon whether this one takes sessions."""
        if self._heartbeat is not None:
            self._heartbeat.beat_now()

    def announce_drain(self) -> None:
        """Tells other servers that this one takes no more sessions."""
        if self._heartbeat is not None:
            self._heartbeat.draining = True
            self._heartbeat.beat_now()

    def close(self) -> None:
        """Writes queued rows and checkpoints within some seconds and releases the locks; blocks."""
        self.history.close_all()
        self.meshes.close()
        if self.checkpoints is not None:
            self.checkpoints.close()
        self.database.close()
        if self._heartbeat is not None:
            self._heartbeat.stop()
        if self._name is not None:
            self._name.release()
        self._release()

    def _take_files(self) -> None:
        """Locks files outside ``data_dir``: a second server on them would end this one's sessions and delete its checkpoints."""
        if (file := self.database.file) is not None:
            self._lock(file, "database_url")
        if self.checkpoints is not None and self.leases is None and (folder := self.checkpoints.folder) is not None:
            self._lock(folder, "checkpoint_url")

    def _lock(self, path: Path, setting: str) -> None:
        path = path.resolve()
        try:
            if setting == "checkpoint_url":  # of a SQLite file the folder has to exist: a mistyped one is no empty database
                make_folder(path.parent)
            self._locks.append(Lock(path.with_name(path.name + ".lock"), setting, str(path)))
        except OSError as error:
            raise InvalidConfig(setting, "a place that can be written", f"{path}: {error.strerror}") from None

    def _take_name(self, metrics: Metrics) -> None:
        """Takes the server's name in PostgreSQL, where it must be unique. A SQLite file belongs to one server anyway."""
        if engine := self.database.lasting_connections():
            name = ServerName(engine, self.server_id, metrics.store_up, metrics.store_errors)
            try:
                name.take()
            except BaseException:
                self.database.close()
                raise
            self._name = name

    def _release(self) -> None:
        for lock in self._locks:
            lock.release()


def _free_bytes(folder: Path) -> float:
    """Free bytes of a folder's disk; not a number while the folder cannot be reached."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return math.nan


def database_url(settings: Settings) -> str:
    """URL of the database with the registry, the history and the keys."""
    if settings.database_url or settings.data_dir == NO_DATA_DIR:
        return settings.database_url or IN_MEMORY
    path = Path(settings.data_dir).expanduser() / "ddakf.sqlite"
    return sa.URL.create("sqlite", database=str(path)).render_as_string()


def exposures(settings: Settings, database: Database, checkpoints: Checkpoints | None = None) -> list[str]:
    """One sentence for each file or folder of the store that users other than its owner may open."""
    folders = [] if settings.data_dir == NO_DATA_DIR else [Path(settings.data_dir).expanduser()]
    folders += [checkpoints.folder] if checkpoints and checkpoints.folder else []
    of_folders = [exposure(folder, FOLDER) for folder in folders]
    of_files = filter(None, (exposure(file, FILE) for file in database.files()))
    return [sentence for sentence in (*of_folders, next(of_files, "")) if sentence]  # the log takes the database's mode


def _checkpoint_url(settings: Settings) -> str:
    if settings.checkpoint_url or settings.data_dir == NO_DATA_DIR:
        return settings.checkpoint_url
    return str(Path(settings.data_dir).expanduser().absolute() / "checkpoints")


def _mesh_url(settings: Settings) -> str:
    """Folder of the meshes. Servers with one ``checkpoint_url`` share it; no server's own folder begins with a dot."""
    if settings.checkpoint_url:
        return f"{settings.checkpoint_url.rstrip('/')}/.meshes"
    if settings.data_dir == NO_DATA_DIR:
        return f"memory://ddakf-meshes-{uuid.uuid4().hex}"
    return str(Path(settings.data_dir).expanduser().absolute() / "meshes")

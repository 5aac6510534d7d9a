"""Checkpoints of sessions: one file or object per session and generation, through fsspec.

Format: magic, version, SHA-256 and length of the rest, serialised SessionSnapshot.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import os
import re
import struct
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import monotonic

from ddakf_api.v1 import tracking_pb2 as pb
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem
from google.protobuf.message import DecodeError

from ddakf.errors import InvalidConfig

from ..observability.metrics import Metrics
from .condition import Condition

log = logging.getLogger(__name__)

_HEADER = struct.Struct("<8sI32sQ")
_MAGIC, _VERSION = b"DDAKFCKP", 1
_SUFFIX, _UNFINISHED = ".checkpoint", ".unfinished"
_FOLDER_NAME = re.compile("[0-9a-f]{16}")
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 15.0  # seconds between attempts while writes fail
_READERS = 4  # threads


class DamagedCheckpoint(ValueError):
    """The bytes are not a complete checkpoint of a known version."""


def pack(snapshot: pb.SessionSnapshot) -> bytes:
    """Serialises a checkpoint."""
    body = snapshot.SerializeToString()
    return _HEADER.pack(_MAGIC, _VERSION, hashlib.sha256(body).digest(), len(body)) + body


def unpack(data: bytes) -> pb.SessionSnapshot:
    """The inverse of :func:`pack`.

    Raises:
        DamagedCheckpoint: the bytes are damaged or of another version.
    """
    if len(data) < _HEADER.size:
        raise DamagedCheckpoint(f"{len(data)} bytes are too few for a checkpoint")
    magic, version, digest, length = _HEADER.unpack_from(data)
    body = memoryview(data)[_HEADER.size :]
    if magic != _MAGIC:
        raise DamagedCheckpoint("the magic bytes are wrong")
    if version != _VERSION:
        raise DamagedCheckpoint(f"the version is {version}; this program reads {_VERSION}")
    if len(body) != length:
        raise DamagedCheckpoint(f"{length} bytes expected, got {len(body)}")
    if hashlib.sha256(body).digest() != digest:
        raise DamagedCheckpoint("the checksum is wrong")
    try:
        return pb.SessionSnapshot.FromString(bytes(body))
    except DecodeError:
        raise DamagedCheckpoint("the content is not a snapshot") from None


class Checkpoints:
    """The checkpoints of one server's sessions, written by one thread.

    Only the newest snapshot of a session is queued. After a failed write it stays in memory until a newer one replaces it or
    a write succeeds. A session therefore survives a lost worker even on a full disk.

    Args:
        url: for fsspec: ``file:///folder``, ``s3://bucket/prefix``, ``memory://...``.
        server_id: folder below the URL, so that servers may share the URL.
        generations: number per session.

    Attributes:
        folder: of the checkpoints, if on this machine's disk; else None.

    Raises:
        InvalidConfig: names ``checkpoint_url``: fsspec does not know its scheme, or the driver is missing.
    """

    def __init__(self, url: str, server_id: str, generations: int, metrics: Metrics):
        try:
            self._files, root = url_to_fs(url, skip_instance_cache=True)
        except (ValueError, ImportError) as error:
            raise InvalidConfig("checkpoint_url", "an fsspec URL whose driver is installed", str(error)) from None
        self._root = f"{root.rstrip('/')}/{server_id}"
        self._local = isinstance(self._files, LocalFileSystem)
        self.folder = Path(self._root) if self._local else None
        self._max_generations, self._metrics = generations, metrics
        self.condition = Condition("checkpoints", metrics.store_up, metrics.store_errors)
        self._changed = threading.Condition()
        self._waiting: dict[int, pb.SessionSnapshot] = {}
        self._writing: tuple[int, pb.SessionSnapshot] | None = None
        self._deleted: set[int] = set()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="checkpoints", daemon=True)
        # A pool of its own: readers of an unreachable store must not occupy the shared threads.
        self._readers = ThreadPoolExecutor(_READERS, "checkpoint-reader")

    def open(self) -> None:
        """Starts the writing thread."""
        self._thread.start()

    def save(self, uid: int, snapshot: pb.SessionSnapshot) -> None:
        """Queues a snapshot, in place of a queued one of the same session; never blocks.

        The snapshot's session should have its name, labels, limits, statistics and creation time: everything that is not in
        the tracker's state.
        """
        with self._changed:
            if uid not in self._deleted:
                self._waiting[uid] = snapshot
                self._changed.notify_all()

    async def newest(self, uid: int) -> pb.SessionSnapshot | None:
        """The newest complete checkpoint of a session, written or queued; None without one.

        Raises:
            OSError: the checkpoints cannot be reached.
        """
        with self._changed:
            if uid in self._waiting:
                return self._waiting[uid]
            if self._writing is not None and self._writing[0] == uid:
                return self._writing[1]
        return await asyncio.get_running_loop().run_in_executor(self._readers, self._read_newest, uid)

    def delete(self, uid: int) -> None:
        """Queues the deletion of all checkpoints of an ended session."""
        with self._changed:
            self._waiting.pop(uid, None)
            self._deleted.add(uid)
            self._changed.notify_all()

    async def keep_only(self, uids: Callable[[], Iterable[int]]) -> None:
        """Deletes the checkpoints of all other sessions. At the start of a server, some may be left from ended sessions.

        Args:
            uids: called after the folders are listed, because sessions may be created meanwhile.

        Raises:
            OSError: the checkpoints cannot be reached.
        """
        names = await asyncio.get_running_loop().run_in_executor(self._readers, self._folders)
        live_folders = {_folder_name(uid) for uid in uids()}
        for name in names:
            if _FOLDER_NAME.fullmatch(name) and name not in live_folders:
                self.delete(int(name, 16))

    def flush(self, timeout: float) -> bool:
        """Waits until the queue is empty; False after ``timeout`` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._waiting or self._writing or self._deleted), timeout)

    def close(self, timeout: float = 10.0) -> None:
        """Tries once to write the queue and ends the thread; blocks at most ``timeout`` seconds."""
        self._closing.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        self._readers.shutdown(wait=False, cancel_futures=True)
        if self._waiting:
            log.error("the checkpoints of %d sessions could not be written before the end", len(self._waiting))

    def _run(self) -> None:
        pause = _FIRST_PAUSE
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._deleted or self._closing.is_set())
            last = self._closing.is_set()
            try:
                try:
                    self._delete_ended()  # first, to free a full disk
                finally:
                    self._write_waiting()
            except Exception as error:
                if not isinstance(error, OSError):
                    log.exception("writing checkpoints failed")
                self.condition.fails(error)
                self._closing.wait(pause)
                pause = min(2 * pause, _LONGEST_PAUSE)
            else:
                pause = _FIRST_PAUSE
            if last:
                return

    def _write_waiting(self) -> None:
        while self._waiting:
            with self._changed:
                uid = next(iter(self._waiting))
                self._writing = uid, self._waiting.pop(uid)
            try:
                self._write(*self._writing)
                self.condition.works()
            except BaseException:
                with self._changed:
                    if uid not in self._deleted:
                        self._waiting.setdefault(uid, self._writing[1])
                raise
            finally:
                with self._changed:
                    self._writing = None
                    self._changed.notify_all()

    def _write(self, uid: int, snapshot: pb.SessionSnapshot) -> None:
        """Writes a new generation atomically, then deletes the oldest ones."""
        started = monotonic()
        data = pack(snapshot)
        folder = self._folder(uid)
        before = self._generations(uid)
        number = 1 + (_number_of(before[-1]) if before else 0)
        path = f"{folder}/{number:012d}{_SUFFIX}"
        if self._local:
            self._files.makedirs(folder, exist_ok=True)
            _write_atomically(path, data)
        else:
            self._files.pipe_file(path, data)  # an object store shows an object only when it is complete
        self._metrics.checkpoint_seconds.observe(monotonic() - started)
        self._metrics.checkpoint_bytes.inc(len(data))
        for old in [*before, path][: -self._max_generations]:
            self._files.rm_file(old)

    def _read_newest(self, uid: int) -> pb.SessionSnapshot | None:
        for path in reversed(self._generations(uid)):
            try:
                return unpack(self._files.cat_file(path))
            except DamagedCheckpoint as error:
                log.error("a damaged checkpoint is skipped: %s", error, extra={"file": path})
        return None

    def _generations(self, uid: int) -> list[str]:
        """Paths, the oldest first."""
        return sorted(path for path in self._list(self._folder(uid)) if path.endswith(_SUFFIX))

    def _folders(self) -> list[str]:
        return [path.rstrip("/").rpartition("/")[2] for path in self._list(self._root)]

    def _list(self, folder: str) -> list[str]:
        try:
            return self._files.ls(folder, detail=False, refresh=True)
        except FileNotFoundError:
            return []

    def _delete_ended(self) -> None:
        while self._deleted:
            uid = next(iter(self._deleted))
            with contextlib.suppress(FileNotFoundError):  # none was written
                self._files.rm(self._folder(uid), recursive=True)
            with self._changed:
                self._deleted.discard(uid)
                self._changed.notify_all()

    def _folder(self, uid: int) -> str:
        return f"{self._root}/{_folder_name(uid)}"


def _folder_name(uid: int) -> str:
    return f"{uid:016x}"


def _number_of(path: str) -> int:
    return int(path.rpartition("/")[2].removesuffix(_SUFFIX))


def _write_atomically(path: str, data: bytes) -> None:
    """Writes a file under a temporary name, which a later start does not read as a checkpoint, and renames it.

    The rename comes before fsync, so that the checkpoint of a killed process is complete. After a power cut the checksum
    reveals missing bytes, and older generations remain.
    """
    unfinished = path + _UNFINISHED
    try:
        with open(unfinished, "wb") as file:
            file.write(data)
            file.flush()
            os.replace(unfinished, path)
            os.fsync(file.fileno())
    except OSError:
        for name in (unfinished, path):
            with contextlib.suppress(FileNotFoundError):
                os.unlink(name)
        raise

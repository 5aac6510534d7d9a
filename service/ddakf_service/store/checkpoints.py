"""Checkpoints of sessions: one file or object per session and generation, through fsspec.

The format: magic, version, SHA-256 and length of what follows, a serialised SessionSnapshot.
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
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 15.0  # seconds between attempts while nothing can be written
_READERS = 4  # threads


class DamagedCheckpoint(ValueError):
    """Bytes that are no whole checkpoint of a known version."""


def pack(snapshot: pb.SessionSnapshot) -> bytes:
    """A checkpoint's bytes."""
    body = snapshot.SerializeToString()
    return _HEADER.pack(_MAGIC, _VERSION, hashlib.sha256(body).digest(), len(body)) + body


def unpack(data: bytes) -> pb.SessionSnapshot:
    """The inverse of :func:`pack`.

    Raises:
        DamagedCheckpoint: the bytes are not what was written, or of another version.
    """
    if len(data) < _HEADER.size:
        raise DamagedCheckpoint(f"{len(data)} bytes are no checkpoint")
    magic, version, digest, length = _HEADER.unpack_from(data)
    body = memoryview(data)[_HEADER.size :]
    if magic != _MAGIC:
        raise DamagedCheckpoint("it does not begin like a checkpoint")
    if version != _VERSION:
        raise DamagedCheckpoint(f"its version is {version}, this program reads {_VERSION}")
    if len(body) != length:
        raise DamagedCheckpoint(f"it should have {length} bytes and has {len(body)}")
    if hashlib.sha256(body).digest() != digest:
        raise DamagedCheckpoint("its checksum is another")
    try:
        return pb.SessionSnapshot.FromString(bytes(body))
    except DecodeError:
        raise DamagedCheckpoint("it holds no snapshot") from None


class Checkpoints:
    """The checkpoints of one server's sessions, written by one thread.

    Only the newest snapshot of a session waits to be written, and one that cannot be written stays in memory until a newer
    one comes or writing works again, so that a lost worker costs no more than usual on a full disk.

    Args:
        url: of fsspec: ``file:///folder``, ``s3://bucket/prefix``, ``memory://...``.
        server_id: a folder below the URL, so that servers may share one.
        keep: generations per session.

    Attributes:
        folder: where they are, if in files of this machine.

    Raises:
        InvalidConfig: naming ``checkpoint_url``: of a kind that fsspec does not know or whose driver is missing.
    """

    def __init__(self, url: str, server_id: str, keep: int, metrics: Metrics):
        try:
            self._files, root = url_to_fs(url, skip_instance_cache=True)
        except (ValueError, ImportError) as error:
            raise InvalidConfig("checkpoint_url", "an fsspec URL whose driver is installed", str(error)) from None
        self._root = f"{root.rstrip('/')}/{server_id}"
        self._local = isinstance(self._files, LocalFileSystem)
        self.folder = Path(self._root) if self._local else None
        self._keep, self._metrics = keep, metrics
        self.condition = Condition("checkpoints", metrics.store_up, metrics.store_errors)
        self._changed = threading.Condition()
        self._waiting: dict[int, pb.SessionSnapshot] = {}
        self._writing: tuple[int, pb.SessionSnapshot] | None = None
        self._deleted: set[int] = set()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="checkpoints", daemon=True)
        # Of its own, for who waits for objects that do not come shall not keep others from a thread.
        self._readers = ThreadPoolExecutor(_READERS, "checkpoint-reader")

    def open(self) -> None:
        """Begins to write."""
        self._thread.start()

    def save(self, uid: int, snapshot: pb.SessionSnapshot) -> None:
        """Leaves a snapshot to be written, in place of one of the same session that still waits; never blocks.

        The session in it should have its name, labels, limits, statistics and creation time: all that is not in the
        tracker's own state.
        """
        with self._changed:
            if uid not in self._deleted:
                self._waiting[uid] = snapshot
                self._changed.notify_all()

    async def newest(self, uid: int) -> pb.SessionSnapshot | None:
        """The newest whole checkpoint of a session, written or not; None where there is none.

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
        """Has all checkpoints of a session deleted; it has ended."""
        with self._changed:
            self._waiting.pop(uid, None)
            self._deleted.add(uid)
            self._changed.notify_all()

    async def keep_only(self, uids: Callable[[], Iterable[int]]) -> None:
        """Deletes the checkpoints of all sessions but these; for the start, where some may be left of ended ones.

        Args:
            uids: asked once it is known what there is: another session may begin before.

        Raises:
            OSError: the checkpoints cannot be reached.
        """
        names = await asyncio.get_running_loop().run_in_executor(self._readers, self._folders)
        wanted = {_folder_name(uid) for uid in uids()}
        for name in names:
            if _FOLDER_NAME.fullmatch(name) and name not in wanted:
                self.delete(int(name, 16))

    def flush(self, timeout: float) -> bool:
        """Waits until everything left so far is written; False where it was not within ``timeout`` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._waiting or self._writing or self._deleted), timeout)

    def close(self, timeout: float = 10.0) -> None:
        """Writes what waits, once, and ends the thread; blocks at most ``timeout`` seconds."""
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
                    self._delete_ended()  # first, for what may be a full disk
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
        """A new generation, whole or not at all; then the oldest ones go."""
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
            self._files.pipe_file(path, data)  # object stores show an object when it is whole
        self._metrics.checkpoint_seconds.observe(monotonic() - started)
        self._metrics.checkpoint_bytes.inc(len(data))
        for old in [*before, path][: -self._keep]:
            self._files.rm_file(old)

    def _read_newest(self, uid: int) -> pb.SessionSnapshot | None:
        for path in reversed(self._generations(uid)):
            try:
                return unpack(self._files.cat_file(path))
            except DamagedCheckpoint as error:
                log.error("a checkpoint is damaged and passed over: %s", error, extra={"file": path})
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
    """Under another name first, which a start after a crash does not take for a checkpoint.

    It has its own name before the disk has its bytes, so that a killed process has left it: after a power cut the checksum
    tells, and the older ones are still there.
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

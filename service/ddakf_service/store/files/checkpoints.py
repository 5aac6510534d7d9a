"""Checkpoints of sessions: one file or object per session and generation, through fsspec.

The name of a generation is its number; where servers share sessions, the epoch of the session's lease comes first. What a server
writes that has lost the lease is therefore older than any checkpoint of its successor.

Format: magic, version, SHA-256 and length of the rest; then the serialised SessionSnapshot and the answers, each behind its
length. Version 1 has the SessionSnapshot alone, without its length.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import re
import struct
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import monotonic
from typing import NamedTuple

from ddakf_api.v1 import tracking_pb2 as pb
from fsspec.implementations.local import LocalFileSystem
from google.protobuf.message import DecodeError

from ddakf.errors import InvalidConfig

from ...observability.metrics import Metrics
from ..condition import Condition
from .object_store import file_system, reaching_store
from .permissions import make_folder
from .written_file import UNFINISHED, write_atomically

log = logging.getLogger(__name__)

_HEADER = struct.Struct("<8sI32sQ")
_PART = struct.Struct("<Q")
_MAGIC, _VERSION, _WITHOUT_ANSWERS = b"DDAKFCKP", 2, 1
_SUFFIX = ".checkpoint"
_FOLDER_NAME = re.compile("[0-9a-f]{16}")
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 15.0  # seconds between attempts while writes fail
_READERS = 4  # threads
_LOOK_INTERVAL = 0.005  # seconds between checks whether a checkpoint is written


class DamagedCheckpoint(ValueError):
    """The bytes are not a complete checkpoint of a known version."""


class Checkpoint(NamedTuple):
    """State of a session to continue from.

    Attributes:
        answers: serialised TrackResponses that its client may not have received.
        epoch: of the session's lease; 0: no other server may have the session. Part of the name, not of the content.
    """

    snapshot: pb.SessionSnapshot
    answers: Sequence[bytes] = ()
    epoch: int = 0


def pack(checkpoint: Checkpoint) -> bytes:
    """Serialises a checkpoint."""
    parts = [checkpoint.snapshot.SerializeToString(), *checkpoint.answers]
    body = b"".join(piece for part in parts for piece in (_PART.pack(len(part)), part))
    return _HEADER.pack(_MAGIC, _VERSION, hashlib.sha256(body).digest(), len(body)) + body


def unpack(data: bytes) -> Checkpoint:
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
    if version not in (_VERSION, _WITHOUT_ANSWERS):
        raise DamagedCheckpoint(f"the version is {version}; this program reads 1 and {_VERSION}")
    if len(body) != length:
        raise DamagedCheckpoint(f"{length} bytes expected, got {len(body)}")
    if hashlib.sha256(body).digest() != digest:
        raise DamagedCheckpoint("the checksum is wrong")
    snapshot, *answers = [body] if version == _WITHOUT_ANSWERS else _parts(body)
    try:
        return Checkpoint(pb.SessionSnapshot.FromString(bytes(snapshot)), tuple(bytes(answer) for answer in answers))
    except DecodeError:
        raise DamagedCheckpoint("the content is not a snapshot") from None


def _parts(body: memoryview) -> list[memoryview]:
    """The parts of a checkpoint, at least one."""
    parts, at = [], 0
    while at < len(body) or not parts:
        if at + _PART.size > len(body):
            raise DamagedCheckpoint("a length is missing")
        (size,) = _PART.unpack_from(body, at)
        begin, at = at + _PART.size, at + _PART.size + size
        if at > len(body):
            raise DamagedCheckpoint(f"a part of {size} bytes is not complete")
        parts.append(body[begin:at])
    return parts


class Checkpoints:
    """The checkpoints of a server's sessions, written by one thread.

    Only the newest snapshot of a session is queued. After a failed write it stays in memory until a newer one replaces it or
    a write succeeds. A session therefore survives a lost worker even on a full disk.

    Args:
        url: for fsspec: ``file:///folder``, ``s3://bucket/prefix``, ``memory://...``.
        folder: below the URL: of this server, or of the servers that share their sessions.
        generations: number per session.

    Attributes:
        folder: of the checkpoints, if on this machine's disk; else None.

    Raises:
        InvalidConfig: names ``checkpoint_url``: fsspec does not know its scheme, or the driver is missing.
    """

    def __init__(self, url: str, folder: str, generations: int, metrics: Metrics):
        try:
            self._files, root = file_system(url)
        except (ValueError, ImportError) as error:
            raise InvalidConfig("checkpoint_url", "an fsspec URL whose driver is installed", str(error)) from None
        self._root = f"{root.rstrip('/')}/{folder}"
        self._local = isinstance(self._files, LocalFileSystem)
        self.folder = Path(self._root) if self._local else None
        self._max_generations, self._metrics = generations, metrics
        self.condition = Condition("checkpoints", metrics.store_up, metrics.store_errors)
        self._changed = threading.Condition()
        self._waiting: dict[int, Checkpoint] = {}
        self._writing: tuple[int, Checkpoint] | None = None
        self._deleted: set[int] = set()
        self._last_size = 0  # bytes of the checkpoint that was written last, or was to be
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="checkpoints", daemon=True)
        # A pool of its own: readers of an unreachable store must not occupy the shared threads.
        self._readers = ThreadPoolExecutor(_READERS, "checkpoint-reader")

    def open(self) -> None:
        """Starts the writing thread."""
        self._thread.start()

    def save(self, uid: int, checkpoint: Checkpoint) -> None:
        """Queues a checkpoint, in place of a queued one of the same session; never blocks.

        The snapshot's session should have its name, labels, limits, statistics and creation time: everything that is not in
        the tracker's state.
        """
        with self._changed:
            if uid not in self._deleted:
                self._waiting[uid] = checkpoint
                self._changed.notify_all()

    async def newest(self, uid: int) -> Checkpoint | None:
        """The newest complete checkpoint of a session, written or queued; None without one.

        Raises:
            OSError: the checkpoints cannot be reached.
        """
        with self._changed:
            writing = self._writing[1] if self._writing is not None and self._writing[0] == uid else None
            queued = self._waiting.get(uid, writing)
        if queued is not None and not queued.epoch:
            return queued
        return await asyncio.get_running_loop().run_in_executor(self._readers, self._read_newest, uid, queued)

    def delete(self, uid: int) -> None:
        """Queues the deletion of all checkpoints of an ended session."""
        with self._changed:
            self._waiting.pop(uid, None)
            self._deleted.add(uid)
            self._changed.notify_all()

    async def written(self, uid: int, timeout: float) -> bool:
        """Waits until the saved checkpoint of a session is written; False after ``timeout`` seconds."""
        deadline = monotonic() + timeout
        while self._is_pending(uid):
            if monotonic() > deadline:
                return False
            await asyncio.sleep(_LOOK_INTERVAL)
        return True

    def _is_pending(self, uid: int) -> bool:
        with self._changed:
            return uid in self._waiting or (self._writing is not None and self._writing[0] == uid)

    async def stored(self) -> list[int]:
        """The sessions that have checkpoints. Raises ``OSError``."""
        names = await asyncio.get_running_loop().run_in_executor(self._readers, self._folders)
        return [int(name, 16) for name in names if _FOLDER_NAME.fullmatch(name)]

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
                self._changed.wait_for(lambda: self._waiting or self._deleted or self._closing.is_set() or self.condition.problem)
            last = self._closing.is_set()
            try:
                self._write_all()
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

    def _write_all(self) -> None:
        with contextlib.nullcontext() if self._local else reaching_store():
            try:
                self._delete_ended()  # first, to free a full disk
            finally:
                self._write_waiting()
            if self.condition.problem:  # all was deleted that could not be written
                self._write_probe()
                self.condition.works()

    def _write_waiting(self) -> None:
        while True:
            with self._changed:
                uid = next(iter(self._waiting), None)  # the last one may just have been deleted
                if uid is None:
                    return
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

    def _write(self, uid: int, checkpoint: Checkpoint) -> None:
        """Writes a new generation atomically, then deletes the oldest ones."""
        started = monotonic()
        data = pack(checkpoint)
        self._last_size = len(data)
        folder = self._folder(uid)
        before = self._generations(uid)
        own = [generation.number for generation in map(_generation, before) if generation.epoch == checkpoint.epoch]
        path = f"{folder}/{_Generation(checkpoint.epoch, 1 + max(own, default=0))}{_SUFFIX}"
        if self._local:
            make_folder(Path(folder))
            write_atomically(path, data)
        else:
            self._files.pipe_file(path, data)  # an object store shows an object only when it is complete
        self._metrics.checkpoint_seconds.observe(monotonic() - started)
        self._metrics.checkpoint_bytes.inc(len(data))
        for old in sorted([*before, path], key=_generation)[: -self._max_generations]:
            with contextlib.suppress(FileNotFoundError):  # the session's next server has deleted it
                self._files.rm_file(old)

    def _write_probe(self) -> None:
        """Writes and deletes as many bytes as the last checkpoint had."""
        path, data = f"{self._root}/probe{UNFINISHED}", bytes(self._last_size)
        try:
            if self._local:
                self._files.makedirs(self._root, exist_ok=True)
            self._files.pipe_file(path, data)
        finally:
            with contextlib.suppress(FileNotFoundError):
                self._files.rm_file(path)

    def _read_newest(self, uid: int, queued: Checkpoint | None = None) -> Checkpoint | None:
        """The newest stored checkpoint, or the queued one if no other server has had the session since it was taken."""
        with reaching_store():
            for path in reversed(self._generations(uid)):
                if queued is not None and queued.epoch >= _generation(path).epoch:
                    return queued
                try:
                    return unpack(self._files.cat_file(path))
                except DamagedCheckpoint as error:
                    log.error("a damaged checkpoint is skipped: %s", error, extra={"file": path})
            return queued

    def _generations(self, uid: int) -> list[str]:
        """Paths, the oldest first."""
        return sorted((path for path in self._list(self._folder(uid)) if path.endswith(_SUFFIX)), key=_generation)

    def _folders(self) -> list[str]:
        with reaching_store():
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


class _Generation(NamedTuple):
    """Name of a checkpoint, in the order of their age."""

    epoch: int
    number: int

    def __str__(self) -> str:
        return f"{self.epoch:08d}-{self.number:012d}" if self.epoch else f"{self.number:012d}"


def _generation(path: str) -> _Generation:
    epoch, _, number = path.rpartition("/")[2].removesuffix(_SUFFIX).rpartition("-")
    return _Generation(int(epoch or 0), int(number))

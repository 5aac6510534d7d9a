"""Data folder of a server, and locks that exclude a second server from its files."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO

from ddakf.errors import InvalidConfig

from .permissions import close_if_empty, make_folder, opener

_LOCK = "lock"


class Lock:
    """A lock file, held from construction to :meth:`release` or to the end of the process.

    Args:
        path: of the lock file, which is created.
        setting: name of the setting that the lock protects.
        place: the protected file or folder, for the message.

    Raises:
        InvalidConfig: names the setting: another server holds the lock. OSError: the file cannot be written.
    """

    def __init__(self, path: Path, setting: str, place: str):
        self._file: IO[bytes] = os.fdopen(opener(path, os.O_WRONLY | os.O_CREAT), "wb")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise InvalidConfig(setting, "a place that no other server uses", place) from None

    def release(self) -> None:
        """Releases the lock."""
        self._file.close()


class DataFolder:
    """A folder with a :class:`Lock`.

    Raises:
        InvalidConfig: names ``data_dir``: another server holds the lock, or the folder cannot be written.
    """

    def __init__(self, path: Path):
        self.path = path
        make_data_folder(path)
        try:
            self._lock = Lock(path / _LOCK, "data_dir", str(path))
        except OSError as error:
            raise _unusable(path, error) from None

    def release(self) -> None:
        """Releases the lock."""
        self._lock.release()


def make_data_folder(path: Path) -> None:
    """Creates a folder that only its owner can read, or closes an empty one to others.

    Raises:
        InvalidConfig: names ``data_dir``.
    """
    try:
        make_folder(path)
        close_if_empty(path)
    except OSError as error:
        raise _unusable(path, error) from None


def _unusable(path: Path, error: OSError) -> InvalidConfig:
    return InvalidConfig("data_dir", 'a folder that can be written, or "none"', f"{path}: {error.strerror}")

"""The folder of a server, and the lock that keeps a second server out of it."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import IO

from ddakf.errors import InvalidConfig

_LOCK = "lock"


class DataFolder:
    """A folder that is one server's own from construction to :meth:`release`, or to the end of the process.

    Raises:
        InvalidConfig: naming ``data_dir``: another server has it, or it cannot be written.
    """

    def __init__(self, path: Path):
        self.path = path
        make_folder(path)
        try:
            self._lock: IO[bytes] = (path / _LOCK).open("ab")
        except OSError as error:
            raise _unusable(path, error) from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._lock.close()
            raise InvalidConfig("data_dir", "a folder that no other server uses", str(path)) from None

    def release(self) -> None:
        """Lets another server in."""
        self._lock.close()


def make_folder(path: Path) -> None:
    """Makes it, for its owner's eyes only, unless it is there.

    Raises:
        InvalidConfig: naming ``data_dir``.
    """
    try:
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise _unusable(path, error) from None


def _unusable(path: Path, error: OSError) -> InvalidConfig:
    return InvalidConfig("data_dir", 'a folder that can be written, or "none"', f"{path}: {error.strerror}")

"""The folder of a server, and the locks that keep a second server out of what belongs to one."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import IO

from ddakf.errors import InvalidConfig

_LOCK = "lock"


class Lock:
    """A file that is one server's own from construction to :meth:`release`, or to the end of the process.

    Args:
        path: of the file, which is made.
        setting: names what it stands for, as ``what`` does in words.

    Raises:
        InvalidConfig: naming the setting: another server has it. OSError: it cannot be written.
    """

    def __init__(self, path: Path, setting: str, what: str):
        self._file: IO[bytes] = path.open("ab")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise InvalidConfig(setting, "a place that no other server uses", what) from None

    def release(self) -> None:
        """Lets another server have it."""
        self._file.close()


class DataFolder:
    """A folder that is one server's own, as with a :class:`Lock`.

    Raises:
        InvalidConfig: naming ``data_dir``: another server has it, or it cannot be written.
    """

    def __init__(self, path: Path):
        self.path = path
        make_folder(path)
        try:
            self._lock = Lock(path / _LOCK, "data_dir", str(path))
        except OSError as error:
            raise _unusable(path, error) from None

    def release(self) -> None:
        """Lets another server in."""
        self._lock.release()


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

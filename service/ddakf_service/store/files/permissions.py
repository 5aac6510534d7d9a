"""Permissions: files and folders that only their owner may read, and sentences about wider ones."""

from __future__ import annotations

import os
import stat
from pathlib import Path

FILE, FOLDER = 0o600, 0o700  # modes of what this package creates
SHARED_FILE = 0o640  # mode of a secret that an administrator gives to a group


def make_folder(path: Path) -> None:
    """Creates a folder, and the missing ones above it, for the owner alone.

    Raises:
        OSError
    """
    if not path.parent.exists():
        make_folder(path.parent)
    try:
        path.mkdir(mode=FOLDER)
    except FileExistsError:
        if not path.is_dir():
            raise


def close_if_empty(path: Path) -> None:
    """Closes an empty folder of this user to others: nobody can depend on its content yet."""
    if path.stat().st_uid == os.geteuid() and not any(path.iterdir()):
        path.chmod(FOLDER)


def make_file(path: Path) -> None:
    """Creates an empty file for the owner alone, unless it exists.

    Raises:
        OSError
    """
    os.close(opener(path, os.O_RDONLY | os.O_CREAT))


def opener(path: str | Path, flags: int) -> int:
    """For the argument ``opener`` of :func:`open`: a new file is for the owner alone."""
    return os.open(path, flags, FILE)


def exposure(path: Path, widest: int) -> str:
    """One sentence if the mode of a file or folder is wider than ``widest``; empty: it is not, or there is none."""
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError:
        return ""
    if not mode & 0o777 & ~widest:
        return ""
    return f"other users may open {path}, whose mode is {mode:04o}: chmod {widest:o} {path}"

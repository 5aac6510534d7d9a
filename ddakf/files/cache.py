"""Cache of what is made once, in a folder of the user's, until nobody uses it: compiled kernels, trained weights."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable
from pathlib import Path
from uuid import uuid4

UNUSED = 30 * 86400.0  # s, after which an entry goes
RECENT = 86400.0  # s, within which none goes, so that no running process loses what it works with
DROPPED = ".dropped"  # ends the name of what is about to go
MOST = 500 * 2**20  # bytes of a kind, beyond which the entries go that were not used for longest


def used(entry: Path | int) -> None:
    """Notes that a file or folder, or the open file of a descriptor, is in use now."""
    os.utime(entry)


def drop_unused(entries: Iterable[Path], most: int = MOST) -> list[Path]:
    """Drops the files and folders of a kind that were not used for :data:`UNUSED`, and beyond ``most`` bytes those not used for
    longest, but none within :data:`RECENT` of its use. Other processes may use and drop entries meanwhile.

    Returns:
        What went.
    """
    now, held, dropped, found = time.time(), 0, [], {}
    for entry in entries:
        try:
            found[entry] = entry.stat().st_mtime, _size(entry)
        except FileNotFoundError:  # another process dropped it
            continue
    for entry, (when, size) in sorted(found.items(), key=lambda item: item[1][0], reverse=True):
        held += size
        if now - when > (RECENT if held > most else UNUSED) and _dropped(entry):
            held -= size
            dropped.append(entry)
    return dropped


def _size(entry: Path) -> int:
    files = [entry] if entry.is_file() else [path for path in entry.rglob("*") if path.is_file()]
    return sum(path.stat().st_size for path in files)


def _dropped(entry: Path) -> bool:
    """Whoever comes meanwhile finds all of it or nothing; False where another process was first, or this one cannot."""
    gone = entry if entry.name.endswith(DROPPED) else entry.with_name(f"{entry.name}.{uuid4().hex[:8]}{DROPPED}")
    try:
        entry.rename(gone)
        gone.unlink() if gone.is_file() else shutil.rmtree(gone)
    except OSError:  # gone, another user's, or on a read-only disk
        return False
    return True

"""Written file: a local file that is complete, or not there."""

from __future__ import annotations

import contextlib
import os

from .permissions import opener

UNFINISHED = ".unfinished"  # suffix of a file while it is written


def write_atomically(path: str, data: bytes) -> None:
    """Writes a file under a temporary name, which no reader takes for a complete one, and renames it.

    The rename comes before fsync, so that the file of a killed process is complete. After a power cut bytes may be missing: a
    reader has to compare a checksum.
    """
    unfinished = path + UNFINISHED
    try:
        with open(unfinished, "wb", opener=opener) as file:
            file.write(data)
            file.flush()
            os.replace(unfinished, path)
            os.fsync(file.fileno())
    except OSError:
        for name in (unfinished, path):
            with contextlib.suppress(FileNotFoundError):
                os.unlink(name)
        raise

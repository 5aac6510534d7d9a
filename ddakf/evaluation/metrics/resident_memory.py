"""Memory that a method takes, whoever allocates it: Python, NumPy, compiled kernels, PyTorch."""

from __future__ import annotations

import ctypes
import gc
import os
from pathlib import Path

STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class ResidentPeak:
    """Growth of the process's peak resident memory since this was made.

    On Linux the kernel keeps the peak (VmHWM) and can be told to start it anew; what the allocator holds free is handed back
    before. tracemalloc would miss what compiled code and PyTorch allocate, and slow down what is timed. To leave out what is
    loaded and compiled once, run the method over two frames before. One at a time in a process.
    """

    def __init__(self) -> None:
        gc.collect()
        self._before = None
        if os.access(RESET, os.W_OK):
            trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's; musl has none
            if trim is not None:
                trim(0)
            RESET.write_text("5")
            self._before = _kilobytes("VmRSS")

    def mib(self) -> float | None:
        """MiB by which the peak since then exceeds what was resident; None where the system does not say."""
        return None if self._before is None else max(0, _kilobytes("VmHWM") - self._before) / 1024


def _kilobytes(name: str) -> int:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(name + ":"))
    return int(line.split()[1])

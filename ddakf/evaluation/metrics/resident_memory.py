"""Resident memory of a method, by any allocator: Python, NumPy, compiled kernels, PyTorch."""

from __future__ import annotations

import ctypes
import gc
import os
from pathlib import Path

STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class ResidentPeak:
    """Growth of the process's peak resident memory since this object was made.

    On Linux the kernel records the peak (VmHWM) and can reset it; free memory of the allocator is returned first. tracemalloc
    would miss the allocations of compiled code and PyTorch, and slow down the timed code. To exclude memory that is loaded or
    compiled once, run the method over two frames before. Only one instance may be in use in a process.
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
        """MiB by which the peak exceeds the resident memory at the start; None where the system does not state it."""
        return None if self._before is None else max(0, _kilobytes("VmHWM") - self._before) / 1024


def _kilobytes(name: str) -> int:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(name + ":"))
    return int(line.split()[1])

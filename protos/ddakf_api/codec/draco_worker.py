"""Draco decoder process: :class:`~ddakf_api.codec.draco.Decoder` runs this file as a script.

Request on standard input: ``<number u64><size u32><data>``. Response on standard output: ``<number u64><count i64><seconds
f64><count * 12 bytes of float32>``, with the number of the request and the CPU time that it took; the count is -1 if the data
cannot be decoded. The process ends with its input. It imports nothing of this package, so that it starts fast.
"""

import os
import resource
import signal
import struct
import sys
from pathlib import Path
from time import process_time

import DracoPy
import numpy as np

_REQUEST, _RESPONSE = struct.Struct("<QI"), struct.Struct("<Qqd")


def main(memory: int, seconds: float) -> None:
    """Decodes one cloud after the other.

    Args:
        memory: bytes of address space beyond that of the idle process; larger allocations fail inside the decoder.
        seconds: CPU time per cloud; a longer one ends the process.
    """
    limit = _address_space() + memory
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    source, sink = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the decoder prints messages about unknown data
    while len(head := source.read(_REQUEST.size)) == _REQUEST.size:
        number, size = _REQUEST.unpack(head)
        data = source.read(size)
        # The default action of the signal ends the process even while the decoder holds the interpreter lock.
        signal.setitimer(signal.ITIMER_PROF, seconds)
        began = process_time()
        points = _decoded(data)
        signal.setitimer(signal.ITIMER_PROF, 0)
        sink.write(_RESPONSE.pack(number, -1 if points is None else len(points), process_time() - began))
        if points is not None:
            sink.write(points.data)
        sink.flush()


def _decoded(data: bytes) -> np.ndarray | None:
    """(N, 3) float32, or None if the data cannot be decoded."""
    try:
        points = np.ascontiguousarray(DracoPy.decode(data).points, "<f4")
    except Exception:  # every failure has the same response
        return None
    return points if points.ndim == 2 and points.shape[1] == 3 else None


def _address_space() -> int:
    """Address space of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))

"""What runs in the process of :class:`~ddakf_api.codec.draco.Decoder`, started by the path of this file.

Reads ``<number u64><size u32><data>`` from standard input and writes ``<the same number u64><count i64><count * 12 bytes of
float32>`` to standard output, count -1 where the data cannot be decoded, until its input ends. Imports nothing of this package:
it has to be up at once.
"""

import os
import resource
import signal
import struct
import sys
from pathlib import Path

import DracoPy
import numpy as np

_REQUEST, _ANSWER = struct.Struct("<QI"), struct.Struct("<Qq")


def main(memory: int, seconds: float) -> None:
    """Decodes one after the other.

    Args:
        memory: bytes of address space beyond what the idle process has; more fails inside the decoder.
        seconds: CPU time of one decode; more ends the process.
    """
    limit = _address_space() + memory
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    source, sink = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the decoder prints where it meets what it does not know
    while len(head := source.read(_REQUEST.size)) == _REQUEST.size:
        number, size = _REQUEST.unpack(head)
        data = source.read(size)
        # The default action ends the process even while the decoder keeps the interpreter locked.
        signal.setitimer(signal.ITIMER_PROF, seconds)
        points = _decoded(data)
        signal.setitimer(signal.ITIMER_PROF, 0)
        sink.write(_ANSWER.pack(number, -1 if points is None else len(points)))
        if points is not None:
            sink.write(points.data)
        sink.flush()


def _decoded(data: bytes) -> np.ndarray | None:
    """(N, 3) float32; None where there are none to be had."""
    try:
        points = np.ascontiguousarray(DracoPy.decode(data).points, "<f4")
    except Exception:  # whatever it is, the answer is the same
        return None
    return points if points.ndim == 2 and points.shape[1] == 3 else None


def _address_space() -> int:
    """Bytes, of this process."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))

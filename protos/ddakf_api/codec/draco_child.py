"""What runs in the process of :class:`~ddakf_api.codec.draco.Decoder`, started by the path of this file.

Reads ``<size u32><data>`` from standard input and writes ``<count i64><count * 12 bytes of float32>`` to standard output,
count -1 where the data cannot be decoded, until its input ends. Imports nothing of this package: it has to be up at once.
"""

import resource
import signal
import struct
import sys
from pathlib import Path

import DracoPy
import numpy as np

_SIZE, _COUNT = struct.Struct("<I"), struct.Struct("<q")


def main(memory: int, seconds: float) -> None:
    """Decodes one after the other.

    Args:
        memory: bytes of address space beyond what the idle process has; more fails inside the decoder.
        seconds: CPU time of one decode; more ends the process.
    """
    limit = _address_space() + memory
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    source, sink = sys.stdin.buffer, sys.stdout.buffer
    while len(head := source.read(_SIZE.size)) == _SIZE.size:
        data = source.read(_SIZE.unpack(head)[0])
        # The default action ends the process even while the decoder keeps the interpreter locked.
        signal.setitimer(signal.ITIMER_PROF, seconds)
        points = _decoded(data)
        signal.setitimer(signal.ITIMER_PROF, 0)
        sink.write(_COUNT.pack(-1 if points is None else len(points)))
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

"""Draco codec: positions only, encoded in Morton order, decoded in a separate process.

The decoder of DracoPy trusts its input: damaged data can exhaust memory, run for minutes or end the process, and it holds the
interpreter lock meanwhile. Therefore the header is checked first, and the decoder runs in a process with limited memory and CPU
time. If this process dies, one cloud is refused, and the next cloud starts a new process.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import struct
import subprocess
import sys
import threading
import weakref
from pathlib import Path

import numpy as np

from ddakf_api.codec import morton
from ddakf_api.codec.quantise import quantise
from ddakf_api.errors import CodecError, Unimplemented

FIELD = "point_cloud.data"
SECONDS = 2.0  # CPU time limit per cloud; a million points take a tenth of it
MEMORY, MEMORY_PER_POINT = 64 << 20, 160  # limits in bytes of the decoder process; a valid cloud takes half

_EXIT_TIMEOUT = 1.0  # seconds from the end of the input to the exit of the process

_REQUEST, _RESPONSE = struct.Struct("<QI"), struct.Struct("<Qq")

# Magic, version 2.2 or 2.3, point cloud, sequential or k-d tree, no flags (no metadata), number of points.
_HEADER = struct.Struct("<5sBBBBHi")
_MAGIC, _VERSIONS, _POINT_CLOUD, _METHODS = b"DRACO", ((2, 2), (2, 3)), 0, (0, 1)
# One attribute: position, float32, three components, not normalised.
_GEOMETRY = bytes([1, 1, 0, 9, 3, 0])


@functools.cache
def installed() -> bool:
    """Whether DracoPy is installed."""
    return importlib.util.find_spec("DracoPy") is not None


def encode(points: np.ndarray, step: float, runs: list[int]) -> tuple[bytes, np.ndarray]:
    """Encodes points in Morton order within each run; returns the data and the order (N,) int64.

    Sequential encoding keeps the runs and the order. It takes a tenth of the time of Draco's k-d tree and a seventh more bytes.
    The positions are float32, whose rounding adds to the error of half a step far from the origin.

    Args:
        points: (N, 3) metres, N > 0.
        step: quantisation step, metres.
        runs: lengths that sum to N.

    Raises:
        CodecError: DracoPy is not installed, a point is not finite, or the extent is too large for the step.
    """
    if not installed():
        raise CodecError(field="codec", expected="the package dracopy, which draco needs", got="none installed")
    import DracoPy

    coordinates, origin = quantise(points, step, morton.BITS)
    _, order = morton.sort_within_runs(morton.interleave(coordinates), runs)
    bits = max(1, int(coordinates.max()).bit_length())
    data = DracoPy.encode(
        np.ascontiguousarray(points[order], np.float32),
        quantization_bits=bits,
        quantization_range=step * ((1 << bits) - 1),
        quantization_origin=origin,
        compression_level=1,
        preserve_order=True,
    )
    return data, order


def require_header(data: bytes, count: int) -> None:
    """Refuses data whose header is not that of a Draco point cloud with ``count`` positions; nothing is decoded."""
    if len(data) < _HEADER.size + len(_GEOMETRY):
        raise CodecError(field=FIELD, expected="a Draco point cloud", got=f"{len(data)} bytes")
    magic, major, minor, kind, method, flags, declared = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise CodecError(field=FIELD, expected='a Draco point cloud, which begins with "DRACO"', got=repr(magic))
    if (major, minor) not in _VERSIONS:
        raise CodecError(field=FIELD, expected="Draco of bitstream version 2.2 or 2.3", got=f"{major}.{minor}")
    if kind != _POINT_CLOUD or method not in _METHODS or flags:
        got = f"geometry type {kind}, method {method}, flags {flags:#x}"
        raise CodecError(field=FIELD, expected="a Draco point cloud without metadata", got=got)
    if declared != count:
        raise CodecError(field=FIELD, expected=f"{count} points (point_count)", got=f"{declared} declared")
    if data[_HEADER.size :].startswith(_GEOMETRY):
        return
    raise CodecError(field=FIELD, expected="Draco with float32 positions alone", got="other or more attributes")


class Decoder:
    """Decodes Draco in a separate process, started by the first cloud and again after a crash.

    Thread-safe; decodes one cloud at a time.

    Args:
        max_points: largest cloud, for which the memory limit of the process is made.
        seconds: CPU time limit per cloud.
    """

    def __init__(self, max_points: int, seconds: float = SECONDS):
        self._memory, self._seconds = MEMORY + MEMORY_PER_POINT * max_points, seconds
        self._process: subprocess.Popen | None = None
        self._requests = 0
        self._lock = threading.Lock()

    def decode(self, data: bytes, count: int) -> np.ndarray:
        """Decodes a cloud of ``count`` points to (count, 3) float64 metres, finite.

        Raises:
            CodecError: invalid data, or decoding exceeded the limits of memory or time.
            Unimplemented: DracoPy is not installed.
        """
        require_header(data, count)
        if not installed():
            raise Unimplemented("point_cloud.codec: Draco needs the package dracopy here", field="point_cloud.codec")
        with self._lock:
            points = self._request(data, count)
        if points is None or len(points) != count or not np.isfinite(points).all():
            got = "data that cannot be decoded" if points is None else f"{len(points)}, or numbers that are not finite"
            raise CodecError(field=FIELD, expected=f"{count} finite positions", got=got)
        return points.astype(np.float64)

    def process_id(self) -> int | None:
        """Id of the decoder process, or None if none runs."""
        return self._process.pid if self._process is not None and self._process.poll() is None else None

    def close(self) -> None:
        """Ends the decoder process."""
        with self._lock:
            self._end()

    def _request(self, data: bytes, expected: int) -> np.ndarray | None:
        if self.process_id() is None:
            self._start()
        try:
            self._requests += 1
            self._process.stdin.write(_REQUEST.pack(self._requests, len(data)) + data)
            self._process.stdin.flush()
            number, count = _RESPONSE.unpack(self._read(_RESPONSE.size))
            if number != self._requests or count > expected:
                raise EOFError  # requests and responses are out of step: no later response can be trusted
            return None if count < 0 else np.frombuffer(self._read(12 * count), "<f4").reshape(count, 3)
        except (OSError, EOFError):
            status = self._end()
            got = "data that ended the decoder" + (f" by signal {-status}" if status < 0 else "")
            raise CodecError(field=FIELD, expected="a Draco point cloud", got=got) from None

    def _read(self, size: int) -> bytes:
        data = self._process.stdout.read(size)
        if len(data) < size:
            raise EOFError
        return data

    def _start(self) -> None:
        self._end()
        script = Path(__file__).with_name("draco_worker.py")
        self._process = subprocess.Popen(
            # -P: modules are not imported from the folder of the script
            [sys.executable, "-P", str(script), str(self._memory), str(self._seconds)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        self._finalizer = weakref.finalize(self, _end, self._process)  # at the end of this object, or of the interpreter

    def _end(self) -> int:
        """Ends the decoder process and returns its exit status."""
        process, self._process = self._process, None
        if process is None:
            return 0
        self._finalizer.detach()
        return _end(process)


def _end(process: subprocess.Popen) -> int:
    process.stdout.close()
    with contextlib.suppress(BrokenPipeError):  # unwritten data for a process that has ended
        process.stdin.close()
    try:
        return process.wait(timeout=_EXIT_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()

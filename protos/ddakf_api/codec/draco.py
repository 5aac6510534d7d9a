"""Draco codec: positions only, encoded in Morton order, decoded in separate processes.

The decoder of DracoPy trusts its input: damaged data can exhaust memory, run for minutes or end the process, and it holds the
interpreter lock meanwhile. Therefore the header is checked first, and the decoder runs in processes with limited memory and CPU
time. If a process dies, one cloud is refused, and another process takes its place.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import signal
import struct
import subprocess
import sys
import threading
import weakref
from pathlib import Path
from time import monotonic

import numpy as np

from ddakf_api.codec import morton
from ddakf_api.codec.quantise import quantise
from ddakf_api.errors import CodecError, FrameTooCostly, Unimplemented

FIELD = "point_cloud.data"
SECONDS = 2.0  # CPU time limit per cloud; a million points take a tenth of it
MEMORY, MEMORY_PER_POINT = 64 << 20, 160  # limits in bytes of the decoder process; a valid cloud takes half

_EXIT_TIMEOUT = 1.0  # seconds from the end of the input to the exit of the process

_REQUEST, _RESPONSE = struct.Struct("<QI"), struct.Struct("<Qqd")

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
    """Decodes Draco in separate processes, started when they are needed and again after a crash.

    Thread-safe. Each thread that decodes has a process of its own meanwhile: none waits for the cloud of another.

    Args:
        max_points: largest cloud, for which the memory limit of a process is made.
        seconds: CPU time limit per cloud.
    """

    def __init__(self, max_points: int, seconds: float = SECONDS):
        self._arguments = str(MEMORY + MEMORY_PER_POINT * max_points), str(seconds)
        self._seconds = seconds
        self._idle: list[_Process] = []
        self._of_thread = threading.local()

    def decode(self, data: bytes, count: int) -> np.ndarray:
        """Decodes a cloud of ``count`` points to (count, 3) float64 metres, finite.

        Raises:
            CodecError: invalid data, or decoding exceeded the limit of memory.
            FrameTooCostly: decoding exceeded the limit of CPU time.
            Unimplemented: DracoPy is not installed.
        """
        require_header(data, count)
        if not installed():
            raise Unimplemented("point_cloud.codec: Draco needs the package dracopy here", field="point_cloud.codec")
        points = self._decoded(data, count)
        if points is None or len(points) != count or not np.isfinite(points).all():
            got = "data that cannot be decoded" if points is None else f"{len(points)}, or numbers that are not finite"
            raise CodecError(field=FIELD, expected=f"{count} finite positions", got=got)
        return points.astype(np.float64)

    def processor_seconds(self) -> float:
        """CPU time that the processes have used for the clouds of the calling thread, seconds."""
        return getattr(self._of_thread, "seconds", 0.0)

    def process_ids(self) -> list[int]:
        """Ids of the processes that wait for a cloud."""
        return [process.id for process in self._idle if process.is_alive]

    def close(self) -> None:
        """Ends the processes that wait for a cloud."""
        while self._idle:
            self._idle.pop().end()

    def _decoded(self, data: bytes, count: int) -> np.ndarray | None:
        process = self._process()
        began, used = monotonic(), 0.0
        try:
            points, used = process.request(data, count)
        except (OSError, EOFError):
            status, used = process.end(), min(monotonic() - began, self._seconds)
            if status == -signal.SIGPROF:
                raise FrameTooCostly(f"the Draco decoder used its {self._seconds:g} s of processor time") from None
            got = "data that ended the decoder" + (f" by signal {-status}" if status < 0 else "")
            raise CodecError(field=FIELD, expected="a Draco point cloud", got=got) from None
        finally:
            self._of_thread.seconds = self.processor_seconds() + used
        self._idle.append(process)
        return points

    def _process(self) -> _Process:
        """A process that waits for a cloud, or a new one."""
        while True:
            try:
                process = self._idle.pop()
            except IndexError:
                return _Process(*self._arguments)
            if process.is_alive:
                return process
            process.end()


class _Process:
    """One decoder process, used by one thread at a time."""

    def __init__(self, *arguments: str):
        script = Path(__file__).with_name("draco_worker.py")
        self._process = subprocess.Popen(
            # -P: modules are not imported from the folder of the script
            [sys.executable, "-P", str(script), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        self._requests = 0
        self._finalizer = weakref.finalize(self, _end, self._process)  # at the end of this object, or of the interpreter

    @property
    def id(self) -> int:
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        return self._process.poll() is None

    def request(self, data: bytes, expected: int) -> tuple[np.ndarray | None, float]:
        """The points, at most ``expected``, or None if the data cannot be decoded; and the CPU time of the process, seconds.

        Raises:
            OSError, EOFError: the process has ended, or its responses are out of step.
        """
        self._requests += 1
        self._process.stdin.write(_REQUEST.pack(self._requests, len(data)) + data)
        self._process.stdin.flush()
        number, count, used = _RESPONSE.unpack(self._read(_RESPONSE.size))
        if number != self._requests or count > expected:
            raise EOFError  # requests and responses are out of step: no later response can be trusted
        return None if count < 0 else np.frombuffer(self._read(12 * count), "<f4").reshape(count, 3), used

    def end(self) -> int:
        """Ends the process and returns its exit status."""
        self._finalizer.detach()
        return _end(self._process)

    def _read(self, size: int) -> bytes:
        data = self._process.stdout.read(size)
        if len(data) < size:
            raise EOFError
        return data


def _end(process: subprocess.Popen) -> int:
    process.stdout.close()
    with contextlib.suppress(BrokenPipeError):  # unwritten data for a process that has ended
        process.stdin.close()
    try:
        return process.wait(timeout=_EXIT_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()

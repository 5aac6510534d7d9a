"""Draco point clouds: geometry alone, written in the order of Morton codes, decoded in a process of their own.

The decoder of DracoPy trusts its input: damaged bytes can take all memory, run for minutes or end the process, and it keeps
Python's interpreter locked meanwhile. So the header is checked first, and what it cannot say is bounded by a child process
with little memory and time; if that dies, it costs one cloud and is started again with the next.
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
SECONDS = 2.0  # of CPU time that one cloud may take; a million points take a tenth of it
MEMORY, MEMORY_PER_POINT = 64 << 20, 160  # bytes that decoding may take; an honest cloud takes half

_PATIENCE = 1.0  # seconds that the child has to end once its input has ended

_REQUEST, _ANSWER = struct.Struct("<QI"), struct.Struct("<Qq")

# Magic, version 2.2 or 2.3, a point cloud, sequential or k-d tree, no flags (no metadata); the number of points.
_HEADER = struct.Struct("<5sBBBBHi")
_MAGIC, _VERSIONS, _POINT_CLOUD, _METHODS = b"DRACO", ((2, 2), (2, 3)), 0, (0, 1)
# One attribute: position, float32, three components, not normalised.
_GEOMETRY = bytes([1, 1, 0, 9, 3, 0])


@functools.cache
def installed() -> bool:
    """Whether DracoPy is there."""
    return importlib.util.find_spec("DracoPy") is not None


def encode(points: np.ndarray, step: float, runs: list[int]) -> tuple[bytes, np.ndarray]:
    """A Draco point cloud, and the order (N,) int64 of its points, in Morton order within each run.

    Sequential encoding of sorted points keeps runs and order, and takes a tenth of the time of Draco's own k-d tree for a seventh
    more bytes. Positions are float32 on the wire: far from the origin that adds its rounding to the half step.

    Args:
        points: (N, 3) metres, N > 0.
        step: quantisation step, metres.
        runs: lengths that sum to N.

    Raises:
        CodecError: DracoPy is not installed, points that are not finite or extend over too many steps.
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
    """Refuses what is no Draco point cloud of exactly ``count`` positions, before anything is decoded."""
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
    """Decodes Draco in a child process, which it starts when first asked and again after it has died.

    Any number of threads may ask; one cloud is decoded at a time.

    Args:
        max_points: of one cloud; the process has memory for as many.
        seconds: CPU time of one cloud.
    """

    def __init__(self, max_points: int, seconds: float = SECONDS):
        self._memory, self._seconds = MEMORY + MEMORY_PER_POINT * max_points, seconds
        self._process: subprocess.Popen | None = None
        self._asked = 0
        self._lock = threading.Lock()

    def decode(self, data: bytes, count: int) -> np.ndarray:
        """(count, 3) float64 metres, finite, of a cloud that declares ``count`` points.

        Raises:
            CodecError: the bytes are none, or decoding them took more memory or time than such a cloud takes.
            Unimplemented: DracoPy is not installed.
        """
        require_header(data, count)
        if not installed():
            raise Unimplemented("point_cloud.codec: Draco needs the package dracopy here", field="point_cloud.codec")
        with self._lock:
            points = self._ask(data, count)
        if points is None or len(points) != count or not np.isfinite(points).all():
            got = "none that can be decoded" if points is None else f"{len(points)}, or numbers that are not finite"
            raise CodecError(field=FIELD, expected=f"{count} finite positions", got=got)
        return points.astype(np.float64)

    def process_id(self) -> int | None:
        """Of the child, if one runs."""
        return self._process.pid if self._process is not None and self._process.poll() is None else None

    def close(self) -> None:
        """Ends the child."""
        with self._lock:
            self._end()

    def _ask(self, data: bytes, expected: int) -> np.ndarray | None:
        if self.process_id() is None:
            self._start()
        try:
            self._asked += 1
            self._process.stdin.write(_REQUEST.pack(self._asked, len(data)) + data)
            self._process.stdin.flush()
            number, count = _ANSWER.unpack(self._read(_ANSWER.size))
            if number != self._asked or count > expected:
                raise EOFError  # the two processes are out of step: none of what follows can be believed
            return None if count < 0 else np.frombuffer(self._read(12 * count), "<f4").reshape(count, 3)
        except (OSError, EOFError):
            status = self._end()
            what = f"one that its decoder, ended by signal {-status}, cannot bear" if status < 0 else "one that ended its decoder"
            raise CodecError(field=FIELD, expected="a Draco point cloud", got=what) from None

    def _read(self, size: int) -> bytes:
        data = self._process.stdout.read(size)
        if len(data) < size:
            raise EOFError
        return data

    def _start(self) -> None:
        self._end()
        child = Path(__file__).with_name("draco_child.py")
        self._process = subprocess.Popen(
            # -P: the folder of the file is no place to import from
            [sys.executable, "-P", str(child), str(self._memory), str(self._seconds)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        self._finalizer = weakref.finalize(self, _end, self._process)  # with this object, or the interpreter

    def _end(self) -> int:
        """Returns the exit status."""
        process, self._process = self._process, None
        if process is None:
            return 0
        self._finalizer.detach()
        return _end(process)


def _end(process: subprocess.Popen) -> int:
    process.stdout.close()
    with contextlib.suppress(BrokenPipeError):  # what was still to be written to a dead process
        process.stdin.close()
    try:
        return process.wait(timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()

"""Numeric arrays of MATLAB files of version 5 (``save -v6`` and ``-v7``, SciPy's ``savemat``).

SciPy's ``loadmat`` reads more formats, but some damaged files end the process, and it unpacks any size that a file states.
Format: The MathWorks, "MAT-File Format", chapter 1. A file is a header of 128 bytes and data elements. An array is an element
that holds others, and may be packed by zlib.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from math import prod
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile

HEADER = 128  # bytes
VERSION = 0x0100  # of the format, in the header
ORDERS = {b"IM": "<", b"MI": ">"}
MOST_BYTES = 1 << 30  # of an array, unpacked
MATRIX, PACKED = 14, 15  # kinds of elements
INT8, INT32, UINT32 = 1, 5, 6  # kinds of elements
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # kinds of elements
NUMERIC = range(6, 16)  # classes of arrays
COMPLEX = 0x0800  # flag of an array of complex numbers


def read_arrays(path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Reads arrays of real numbers by their names.

    Args:
        path: of the file.
        names: of the wanted arrays; others, structures and texts are skipped.

    Returns:
        Arrays by name, of two or more dimensions, in their stored type: MATLAB stores whole numbers in the smallest one.

    Raises:
        InvalidFile: no such file, not of this format, damaged, or an array beyond :data:`MOST_BYTES`.
    """
    path = Path(path)
    if not path.is_file():
        raise InvalidFile(str(path), "a MATLAB file", "a folder" if path.is_dir() else "nothing there")
    data = path.read_bytes()
    order = ORDERS.get(data[126:HEADER])
    if order is None or struct.unpack_from(f"{order}H", data, 124)[0] != VERSION:
        raise InvalidFile(str(path), "a MATLAB file of version 5 (save -v7)", "another format")
    try:
        return dict(_arrays(memoryview(data)[HEADER:], order, names))
    except (ValueError, OverflowError, MemoryError, zlib.error, struct.error) as error:
        raise InvalidFile(str(path), "a MATLAB file that is whole", f"{type(error).__name__}: {error}") from error


def _arrays(data: memoryview, order: str, names: Collection[str]) -> Iterator[tuple[str, np.ndarray]]:
    for kind, content in _elements(data, order):
        if kind == PACKED:
            kind, content = next(_elements(_unpacked(content), order))
        if kind == MATRIX:
            parts = _elements(content, order)
            flags, shape, name = (_expected(parts, (kind,))[1] for kind in (UINT32, INT32, INT8))
            (flags,) = struct.unpack_from(f"{order}I", flags)
            name = bytes(name).decode("latin-1")
            if name in names and flags & 0xFF in NUMERIC and not flags & COMPLEX:
                yield name, _array(*_expected(parts, NUMBERS), order, np.frombuffer(shape, f"{order}i4").tolist())


def _array(kind: int, content: memoryview, order: str, shape: list[int]) -> np.ndarray:
    values = np.frombuffer(content, order + NUMBERS[kind])
    if len(shape) < 2 or min(shape) < 0 or prod(shape) != len(values):
        raise ValueError(f"{len(values)} numbers for an array of shape {shape}")
    return values.astype(NUMBERS[kind]).reshape(shape, order="F")


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Kind and content of the elements, one after the other; up to four bytes stand in the tag itself."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:
            kind, size, start, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        else:
            start = at + 8
            after = start + size + (-size % 8 if kind != PACKED else 0)
        if start + size > len(data) or (start == at + 4 and size > 4):
            raise ValueError(f"an element of {size} bytes where {len(data) - start} are left")
        yield kind, data[start : start + size]
        at = after


def _expected(parts: Iterator[tuple[int, memoryview]], kinds: Collection[int]) -> tuple[int, memoryview]:
    kind, content = next(parts, (0, memoryview(b"")))
    if kind not in kinds:
        raise ValueError(f"an element of kind {kind}")
    return kind, content


def _unpacked(content: memoryview) -> memoryview:
    stream = zlib.decompressobj()
    data = stream.decompress(content, MOST_BYTES)
    if not stream.eof or len(data) < 8:
        raise ValueError(f"a packed array that is cut off or beyond {MOST_BYTES} bytes")
    return memoryview(data)

"""Morton codes: the interleaved bits of three coordinates. Points with similar codes are close in space.

Interleaving and separation use lookup tables of 16 and 32 kB, which fit into the first-level cache.
"""

from __future__ import annotations

import numpy as np

BITS = 21
"""Bits per coordinate: three coordinates fill 63 of the 64 bits of a code."""

_HALF = 11
_CHUNK = 12


def _spread_table() -> np.ndarray:
    values = np.arange(1 << _HALF, dtype=np.uint64)
    table = np.zeros_like(values)
    for bit in range(_HALF):
        table |= ((values >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit)
    return table


def _gather_table() -> np.ndarray:
    """Maps 12 bits of a code to 4 bits of x at bit 0, of y at bit 21, of z at bit 42."""
    values = np.arange(1 << _CHUNK, dtype=np.uint64)
    table = np.zeros_like(values)
    for bit in range(_CHUNK):
        position = BITS * (bit % 3) + bit // 3
        table |= ((values >> np.uint64(bit)) & np.uint64(1)) << np.uint64(position)
    return table


_SPREAD = _spread_table()
_GATHER = _gather_table()


def interleave(coordinates: np.ndarray) -> np.ndarray:
    """(N,) uint64 codes of (3, N) int64 coordinates in [0, 2^21): bit 3b is bit b of x, then y, then z."""
    codes = np.zeros(coordinates.shape[1], np.uint64)
    for axis, column in enumerate(coordinates):
        spread = _SPREAD[column & ((1 << _HALF) - 1)]
        high = column >> _HALF
        if high.max(initial=0):
            spread |= _SPREAD[high] << np.uint64(3 * _HALF)
        codes |= spread << np.uint64(axis)
    return codes


def separate(codes: np.ndarray) -> np.ndarray:
    """(3, N) uint64 coordinates of (N,) uint64 codes below 2^63."""
    packed = np.zeros(len(codes), np.uint64)
    chunks = -(-int(codes.max(initial=0)).bit_length() // _CHUNK)
    for chunk in range(chunks):
        index = (codes >> np.uint64(_CHUNK * chunk)) & np.uint64((1 << _CHUNK) - 1)
        packed |= _GATHER[index.view(np.int64)] << np.uint64(_CHUNK // 3 * chunk)
    shifts = np.array([[0], [BITS], [2 * BITS]], np.uint64)
    return (packed >> shifts) & np.uint64((1 << BITS) - 1)


def sort_within_runs(codes: np.ndarray, runs: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Sorts codes inside each run; returns them and the permutation (N,) int64 with sorted = codes[permutation].

    If code and index together fit into 64 bits, they are sorted as one number: numpy.sort is several times faster than
    numpy.argsort.
    """
    index_bits = max(len(codes) - 1, 0).bit_length()
    packed = int(codes.max(initial=0)).bit_length() + index_bits <= 64
    order = np.arange(len(codes), dtype=np.uint64)
    if packed:
        order |= codes << np.uint64(index_bits)
    start = 0
    for length in runs:
        run = slice(start, start + length)
        if packed:
            order[run].sort()
        else:
            order[run] = start + np.argsort(codes[run], kind="stable")
        start += length
    if packed:
        return order >> np.uint64(index_bits), (order & np.uint64((1 << index_bits) - 1)).view(np.int64)
    order = order.view(np.int64)
    return codes[order], order

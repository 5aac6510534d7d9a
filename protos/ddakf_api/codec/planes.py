"""Byte planes: Morton codes as differences, split into planes of equal significance and compressed.

Sorted codes have small differences, whose high bytes are nearly all zero. Stored plane by plane they compress to almost
nothing. Differences are modulo 256^P: a run that begins at a lower code needs no extra byte and no marker.
"""

from __future__ import annotations

import numpy as np

from ddakf_api.codec import compress
from ddakf_api.errors import CodecError

MAX_PLANES = 8

_FIELD = "point_cloud.data"


def to_planes(codes: np.ndarray) -> bytes:
    """(N,) uint64 codes, N > 0, as P * N bytes. P is the smallest number of bytes for the largest code."""
    planes = max(1, -(-int(codes.max()).bit_length() // 8))
    differences = np.diff(codes, prepend=np.uint64(0)).astype("<u8", copy=False)
    return differences.view(np.uint8).reshape(-1, MAX_PLANES)[:, :planes].T.tobytes()


def from_planes(data: bytes, count: int) -> np.ndarray:
    """(count,) uint64 codes from P * count bytes.

    Raises:
        CodecError: the data is not 1 to 8 whole planes, or a code has more than 63 bits.
    """
    planes = _require_whole_planes(len(data), count)
    words = np.zeros((count, MAX_PLANES), np.uint8)
    words[:, :planes] = np.frombuffer(data, np.uint8).reshape(planes, count).T
    codes = np.cumsum(words.view("<u8").ravel(), dtype=np.uint64)
    if planes < MAX_PLANES:
        codes &= np.uint64((1 << (8 * planes)) - 1)
    elif int(codes.max()) >> 63:
        raise CodecError(field=_FIELD, expected="codes of at most 63 bits", got="a longer one")
    return codes


def zstd_decompress(data: bytes, count: int) -> bytes:
    """The planes of `count` codes from a zstd frame; raises :class:`CodecError` for any other data."""
    return compress.zstd_decompress(data, lambda size: _require_whole_planes(size, count), _FIELD)


def deflate_decompress(data: bytes, count: int) -> bytes:
    """The planes of `count` codes from a zlib stream; raises :class:`CodecError` for any other data."""
    return compress.inflate(data, MAX_PLANES * count, _FIELD)


def _require_whole_planes(size: int, count: int) -> int:
    planes, rest = divmod(size, count)
    if rest or not 1 <= planes <= MAX_PLANES:
        raise CodecError(
            field=_FIELD, expected=f"1 to {MAX_PLANES} planes of {count} bytes (point_count)", got=f"{size} bytes"
        )
    return planes


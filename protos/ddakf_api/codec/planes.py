"""Differences of codes in byte planes, and the two compressors over them, bounded by their number.

Sorted codes differ by little, so the high bytes of the differences are nearly all zero: held plane by plane they vanish
under any general compressor. Differences are taken modulo 256^P, so that a run that starts over costs nothing extra and
the planes need not say where runs begin.
"""

from __future__ import annotations

import numpy as np

from ddakf_api.codec import compress
from ddakf_api.errors import CodecError

MAX_PLANES = 8

_FIELD = "point_cloud.data"


def to_planes(codes: np.ndarray) -> bytes:
    """(N,) uint64 codes, N > 0, as P * N bytes, with the smallest P that holds the largest code."""
    planes = max(1, -(-int(codes.max()).bit_length() // 8))
    differences = np.diff(codes, prepend=np.uint64(0)).astype("<u8", copy=False)
    return differences.view(np.uint8).reshape(-1, MAX_PLANES)[:, :planes].T.tobytes()


def from_planes(data: bytes, count: int) -> np.ndarray:
    """(count,) uint64 codes of P * count bytes.

    Raises:
        CodecError: the bytes are not 1 to 8 whole planes, or a code needs more than 63 bits.
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
    """The planes of `count` codes; raises :class:`CodecError` where the frame is not what it should be."""
    return compress.zstd_decompress(data, lambda size: _require_whole_planes(size, count), _FIELD)


def deflate_decompress(data: bytes, count: int) -> bytes:
    """The planes of `count` codes; raises :class:`CodecError` where the stream is not what it should be."""
    return compress.inflate(data, MAX_PLANES * count, _FIELD)


def _require_whole_planes(size: int, count: int) -> int:
    planes, rest = divmod(size, count)
    if rest or not 1 <= planes <= MAX_PLANES:
        raise CodecError(
            field=_FIELD, expected=f"1 to {MAX_PLANES} planes of {count} bytes (point_count)", got=f"{size} bytes"
        )
    return planes


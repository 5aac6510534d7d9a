"""Differences of codes in byte planes, and the two bounded compressors over them.

Sorted codes differ by little, so the high bytes of the differences are nearly all zero: held plane by plane they vanish
under any general compressor. Differences are taken modulo 256^P, so that a run that starts over costs nothing extra and
the planes need not say where runs begin.
"""

from __future__ import annotations

import zlib

import numpy as np
import zstandard

from ddakf_api.errors import CodecError

MAX_PLANES = 8
LEVEL = 1  # of both compressors: higher ones gain under 3 % and cost several times the time
MAX_WINDOW_BYTES = 1 << 23  # what every zstd decoder has to support; level 1 writes far smaller ones

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


def zstd_compress(data: bytes) -> bytes:
    """One zstd frame with its content size and a checksum."""
    return zstandard.ZstdCompressor(level=LEVEL, write_checksum=True, write_content_size=True).compress(data)


def zstd_decompress(data: bytes, count: int) -> bytes:
    """The planes of `count` codes. What the frame declares is checked first: zstandard would allocate as much at once.

    Raises:
        CodecError: no such frame, one that declares another size or a large window, or one that is damaged.
    """
    try:
        header = zstandard.get_frame_parameters(data)
        if header.content_size in (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR):
            raise CodecError(field=_FIELD, expected="a zstd frame that declares its content size", got="none declared")
        _require_whole_planes(header.content_size, count)
        if header.window_size > MAX_WINDOW_BYTES:
            got = f"{header.window_size} bytes"
            raise CodecError(field=_FIELD, expected=f"a zstd window of at most {MAX_WINDOW_BYTES} bytes", got=got)
        return zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES).decompress(data, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CodecError(field=_FIELD, expected="one whole zstd frame", got=_first_line(error)) from None


def deflate_compress(data: bytes) -> bytes:
    """A zlib stream."""
    return zlib.compress(data, LEVEL)


def deflate_decompress(data: bytes, count: int) -> bytes:
    """The planes of `count` codes; inflating stops one byte above the largest size they may have.

    Raises:
        CodecError: no zlib stream, one that is damaged, goes on, or holds more than the planes.
    """
    inflater = zlib.decompressobj()
    try:
        planes = inflater.decompress(data, MAX_PLANES * count + 1)
    except zlib.error as error:
        raise CodecError(field=_FIELD, expected="one whole zlib stream", got=_first_line(error)) from None
    if len(planes) > MAX_PLANES * count:
        raise CodecError(field=_FIELD, expected=f"at most {MAX_PLANES * count} bytes when inflated", got="more")
    if not inflater.eof:
        raise CodecError(field=_FIELD, expected="one whole zlib stream", got=f"{len(data)} bytes without its end")
    if inflater.unused_data:
        raise CodecError(field=_FIELD, expected="one zlib stream", got=f"{len(inflater.unused_data)} bytes after it")
    return planes


def _require_whole_planes(size: int, count: int) -> int:
    planes, rest = divmod(size, count)
    if rest or not 1 <= planes <= MAX_PLANES:
        raise CodecError(
            field=_FIELD, expected=f"1 to {MAX_PLANES} planes of {count} bytes (point_count)", got=f"{size} bytes"
        )
    return planes


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:120]

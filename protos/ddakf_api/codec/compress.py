"""The general compressors of payloads, each bounded before memory is taken."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import zstandard

from ddakf_api.errors import CodecError, first_line

LEVEL = 1  # of both compressors: higher ones gain under 3 % and cost several times the time
MAX_WINDOW_BYTES = 1 << 23  # what every zstd decoder has to support; level 1 writes far smaller ones


def zstd_compress(data: bytes) -> bytes:
    """One zstd frame with its content size and a checksum."""
    return zstandard.ZstdCompressor(level=LEVEL, write_checksum=True, write_content_size=True).compress(data)


def zstd_decompress(data: bytes, require_size: Callable[[int], object], field: str) -> bytes:
    """What a zstd frame holds. What it declares is checked first: zstandard would allocate as much at once.

    Args:
        require_size: raises unless a frame may declare this many bytes.
        field: name for errors.

    Raises:
        CodecError: no such frame, one that declares no size or a large window, or one that is damaged.
    """
    try:
        header = zstandard.get_frame_parameters(data)
        if header.content_size in (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR):
            raise CodecError(field=field, expected="a zstd frame that declares its content size", got="none declared")
        require_size(header.content_size)
        if header.window_size > MAX_WINDOW_BYTES:
            got = f"{header.window_size} bytes"
            raise CodecError(field=field, expected=f"a zstd window of at most {MAX_WINDOW_BYTES} bytes", got=got)
        return zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES).decompress(data, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CodecError(field=field, expected="one whole zstd frame", got=first_line(error)) from None


def deflate_compress(data: bytes) -> bytes:
    """A zlib stream."""
    return zlib.compress(data, LEVEL)


def inflate(data: bytes, most: int, field: str) -> bytes:
    """What a zlib stream holds; inflating stops one byte above the largest size, ``most``.

    Raises:
        CodecError: no zlib stream, one that is damaged, goes on, or holds more.
    """
    inflater = zlib.decompressobj()
    try:
        inflated = inflater.decompress(data, most + 1)
    except zlib.error as error:
        raise CodecError(field=field, expected="one whole zlib stream", got=first_line(error)) from None
    if len(inflated) > most:
        raise CodecError(field=field, expected=f"at most {most} bytes when inflated", got="more")
    if not inflater.eof:
        raise CodecError(field=field, expected="one whole zlib stream", got=f"{len(data)} bytes without its end")
    if inflater.unused_data:
        raise CodecError(field=field, expected="one zlib stream", got=f"{len(inflater.unused_data)} bytes after it")
    return inflated

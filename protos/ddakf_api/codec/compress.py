"""General-purpose compression: zstd and deflate, with the decompressed size bounded before memory is allocated."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import zstandard

from ddakf_api.errors import CodecError, first_line

LEVEL = 1  # of both compressors; higher levels save under 3 % and take several times as long
MAX_WINDOW_BYTES = 1 << 23  # every zstd decoder has to support it; level 1 writes far smaller windows


def zstd_compress(data: bytes) -> bytes:
    """Compresses into one zstd frame with content size and checksum."""
    return zstandard.ZstdCompressor(level=LEVEL, write_checksum=True, write_content_size=True).compress(data)


def zstd_decompress(data: bytes, require_size: Callable[[int], object], field: str) -> bytes:
    """Decompresses one zstd frame. The declared size is checked first, because zstandard allocates it at once.

    Args:
        require_size: raises unless the frame may declare this content size in bytes.
        field: name of the field in errors.

    Raises:
        CodecError: not one zstd frame, no declared size, too large a window, or damaged data.
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
    """Compresses into a zlib stream."""
    return zlib.compress(data, LEVEL)


def inflate(data: bytes, max_bytes: int, field: str) -> bytes:
    """Decompresses one zlib stream; stops one byte above ``max_bytes``.

    Raises:
        CodecError: not one whole zlib stream, damaged data, or more than ``max_bytes``.
    """
    inflater = zlib.decompressobj()
    try:
        inflated = inflater.decompress(data, max_bytes + 1)
    except zlib.error as error:
        raise CodecError(field=field, expected="one whole zlib stream", got=first_line(error)) from None
    if len(inflated) > max_bytes:
        raise CodecError(field=field, expected=f"at most {max_bytes} bytes when inflated", got="more")
    if not inflater.eof:
        raise CodecError(field=field, expected="one whole zlib stream", got=f"{len(data)} bytes without its end")
    if inflater.unused_data:
        raise CodecError(field=field, expected="one zlib stream", got=f"{len(inflater.unused_data)} bytes after it")
    return inflated

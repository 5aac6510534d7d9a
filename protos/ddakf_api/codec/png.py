"""Greyscale PNG of 8 or 16 bits. Pillow reads only a checked header and the pixel data."""

from __future__ import annotations

import functools
import importlib.util
import io
import struct

import numpy as np

from ddakf_api.errors import CodecError, Unimplemented, first_line

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHUNK = struct.Struct(">I4s")
_HEADER = struct.Struct(">IIBBBBB")  # width, height, bits, colour type, compression, filter, interlace
_CRITICAL = (b"IHDR", b"IDAT", b"IEND")  # other chunks, which may expand without bound, are removed


@functools.cache
def installed() -> bool:
    """Whether Pillow is installed."""
    return importlib.util.find_spec("PIL") is not None


def compress(image: np.ndarray) -> bytes:
    """Encodes a (H, W) uint8 or uint16 image as PNG.

    Raises:
        CodecError: Pillow is not installed.
    """
    if not installed():
        raise CodecError(field="compression", expected="the package pillow, which png needs", got="none installed")
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(stream, "PNG", compress_level=1)
    return stream.getvalue()


def decompress(data: bytes, shape: tuple[int, int], dtype: np.dtype, field: str) -> np.ndarray:
    """Decodes an image of this shape (height, width) and type (uint8 or uint16).

    Raises:
        CodecError: not a PNG, a PNG of another size or type, or a damaged PNG.
        Unimplemented: Pillow is not installed.
    """
    if not installed():
        raise Unimplemented(f"{field}: PNG needs the package pillow here", field=field)
    from PIL import Image

    critical = _critical_chunks(data, shape, 8 * dtype.itemsize, field)
    try:
        with Image.open(io.BytesIO(critical), formats=["PNG"]) as image:
            pixels = np.asarray(image)
    except (OSError, SyntaxError, ValueError, EOFError, struct.error) as error:
        raise CodecError(field=field, expected="one whole PNG", got=f"a damaged PNG ({first_line(error)})") from None
    return pixels.astype(dtype)


def _critical_chunks(data: bytes, shape: tuple[int, int], bits: int, field: str) -> bytes:
    """The PNG without ancillary chunks; raises :class:`CodecError` unless its header is the expected one."""
    if not data.startswith(_SIGNATURE):
        raise CodecError(field=field, expected="a PNG", got=f"{len(data)} bytes without its signature")
    chunks, offset, first, kind = [_SIGNATURE], len(_SIGNATURE), True, b""
    while kind != b"IEND":
        if offset + _CHUNK.size > len(data):
            raise CodecError(field=field, expected="one whole PNG", got="a truncated PNG")
        size, kind = _CHUNK.unpack_from(data, offset)
        end = offset + _CHUNK.size + size + 4
        if end > len(data):
            raise CodecError(field=field, expected="one whole PNG", got="a truncated PNG")
        if first != (kind == b"IHDR"):
            raise CodecError(field=field, expected="a PNG with one header, the first chunk", got=repr(kind))
        if first:
            _require_header(data[offset + _CHUNK.size : end - 4], shape, bits, field)
        if kind in _CRITICAL:
            chunks.append(data[offset:end])
        offset, first = end, False
    return b"".join(chunks)


def _require_header(data: bytes, shape: tuple[int, int], bits: int, field: str) -> None:
    if len(data) != _HEADER.size:
        raise CodecError(field=field, expected="a PNG header", got=f"{len(data)} bytes")
    width, height, depth, colour, _, _, interlace = _HEADER.unpack(data)
    if (height, width) != shape:
        raise CodecError(field=field, expected=f"{shape[1]} x {shape[0]} pixels", got=f"{width} x {height}")
    if (depth, colour, interlace) != (bits, 0, 0):
        got = f"{depth} bits of colour type {colour}{', interlaced' if interlace else ''}"
        raise CodecError(field=field, expected=f"{bits}-bit greyscale, not interlaced", got=got)

"""Greyscale PNG of 8 or 16 bits, with Pillow, which sees nothing but a header that has been checked and the pixels."""

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
_KEPT = (b"IHDR", b"IDAT", b"IEND")  # all others, which may unfold to anything, are left out


@functools.cache
def installed() -> bool:
    """Whether Pillow is there."""
    return importlib.util.find_spec("PIL") is not None


def compress(image: np.ndarray) -> bytes:
    """A PNG of a (H, W) uint8 or uint16 image.

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
    """The image of this shape, (height, width), and type, uint8 or uint16.

    Raises:
        CodecError: no PNG, one of another size or kind than expected, or a damaged one.
        Unimplemented: Pillow is not installed.
    """
    if not installed():
        raise Unimplemented(f"{field}: PNG needs the package pillow here", field=field)
    from PIL import Image

    essential = _essential(data, shape, 8 * dtype.itemsize, field)
    try:
        with Image.open(io.BytesIO(essential), formats=["PNG"]) as image:
            pixels = np.asarray(image)
    except (OSError, SyntaxError, ValueError, EOFError, struct.error) as error:
        raise CodecError(field=field, expected="one whole PNG", got=f"a damaged one ({first_line(error)})") from None
    return pixels.astype(dtype)


def _essential(data: bytes, shape: tuple[int, int], bits: int, field: str) -> bytes:
    """The PNG without its ancillary chunks, whose header says what is expected."""
    if not data.startswith(_SIGNATURE):
        raise CodecError(field=field, expected="a PNG", got=f"{len(data)} bytes that begin otherwise")
    kept, place, first, kind = [_SIGNATURE], len(_SIGNATURE), True, b""
    while kind != b"IEND":
        if place + _CHUNK.size > len(data):
            raise CodecError(field=field, expected="one whole PNG", got="one without its end")
        size, kind = _CHUNK.unpack_from(data, place)
        end = place + _CHUNK.size + size + 4
        if end > len(data):
            raise CodecError(field=field, expected="one whole PNG", got="one without its end")
        if first != (kind == b"IHDR"):
            raise CodecError(field=field, expected="a PNG of one header, first", got=repr(kind))
        if first:
            _require_header(data[place + _CHUNK.size : end - 4], shape, bits, field)
        if kind in _KEPT:
            kept.append(data[place:end])
        place, first = end, False
    return b"".join(kept)


def _require_header(data: bytes, shape: tuple[int, int], bits: int, field: str) -> None:
    if len(data) != _HEADER.size:
        raise CodecError(field=field, expected="a PNG header", got=f"{len(data)} bytes")
    width, height, depth, colour, _, _, interlace = _HEADER.unpack(data)
    if (height, width) != shape:
        raise CodecError(field=field, expected=f"{shape[1]} x {shape[0]} pixels", got=f"{width} x {height}")
    if (depth, colour, interlace) != (bits, 0, 0):
        got = f"{depth} bits of colour type {colour}{', interlaced' if interlace else ''}"
        raise CodecError(field=field, expected=f"{bits}-bit greyscale, not interlaced", got=got)

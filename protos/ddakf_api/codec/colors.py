"""Colors of points and pixels: three bytes each, red, green, blue, uncompressed."""

from __future__ import annotations

import math

import numpy as np

from ddakf_api.arrays import checked_array
from ddakf_api.errors import CodecError


def checked_colors(colors: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The colors to send.

    Args:
        colors: uint8, red, green, blue.
        shape: that they must have, (N, 3) or (H, W, 3).

    Raises:
        CodecError: another shape or type.
    """
    expected = f"uint8 of shape {shape}"
    colors = checked_array("colors", colors, expected=expected, kinds="u", columns=None, error=CodecError)
    if colors.shape != shape or colors.dtype != np.uint8:
        raise CodecError(field="colors", expected=expected, got=f"{colors.dtype} of shape {colors.shape}")
    return colors


def colors_of(data: bytes, shape: tuple[int, ...], field: str, items: str) -> np.ndarray | None:
    """Received colors, uint8 of this shape; None where there are none.

    Raises:
        CodecError: not three bytes per item.
    """
    if not data:
        return None
    if len(data) != math.prod(shape):
        expected = f"none, or {math.prod(shape)} bytes, 3 for each of the {math.prod(shape[:-1])} {items}"
        raise CodecError(field=field, expected=expected, got=f"{len(data)} bytes")
    return np.frombuffer(data, np.uint8).reshape(shape)

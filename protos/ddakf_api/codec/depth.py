"""Depth-image codecs: arrays to ``DepthImage`` messages and back. Unprojection is the tracker's task."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ddakf_api.arrays import checked_array
from ddakf_api.codec import compress, png, rvl
from ddakf_api.codec.colors import checked_colors, colors_of
from ddakf_api.codec.sensors import pose_matrix
from ddakf_api.errors import CodecError, InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb

DEPTH_CODECS = {
    "none": pb.DEPTH_COMPRESSION_NONE,
    "zstd": pb.DEPTH_COMPRESSION_ZSTD,
    "png": pb.DEPTH_COMPRESSION_PNG,
    "rvl": pb.DEPTH_COMPRESSION_RVL,
}
"""Compressions by the name in the API; png needs the package pillow, png and rvl need uint16."""

DEFAULT_DEPTH_CODEC = "zstd"
DEFAULT_SCALE = 0.001
"""Metres per unit of uint16 depth."""

_ROTATION_ERROR = 1e-3  # largest element of R R' - I; float32 poses stay far below
_LAST_ROW_ERROR = 1e-6  # of a 4 x 4 pose
_BYTES_PER_PIXEL, _HEADER_BYTES = 5, 1 << 16  # upper bounds of a compressed float32 pixel and of a header


class Depth(NamedTuple):
    """A decoded depth image.

    Attributes:
        depth: (H, W) float32 metres along the optical axis; not positive, or not finite: no measurement.
        keep: (H, W) bool, pixels inside the mask with enough confidence; None: all.
        intrinsics: fx, fy, cx, cy, pixels.
        pose: (3, 4) float64 [R | t], sensor to world, metres.
        colors: (H, W, 3) uint8, red, green, blue; None: unknown.
    """

    depth: np.ndarray
    keep: np.ndarray | None
    intrinsics: tuple[float, float, float, float]
    pose: np.ndarray
    colors: np.ndarray | None = None


def encode_depth(
    depth: np.ndarray,
    intrinsics: Sequence[float],
    *,
    pose: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    confidence: np.ndarray | None = None,
    min_confidence: int = 0,
    colors: np.ndarray | None = None,
    depth_scale: float = DEFAULT_SCALE,
    codec: str = DEFAULT_DEPTH_CODEC,
) -> pb.DepthImage:
    """The message of a depth image.

    Args:
        depth: (H, W) along the optical axis, 0 or NaN for none: floats in metres, or uint16 in units of ``depth_scale``.
        intrinsics: fx, fy, cx, cy, pixels; pixel (0, 0) is the centre of the top left one.
        pose: (3, 4) or (4, 4) [R | t], camera axes (x right, y down, z forward) to world, metres; None: the identity.
        mask: (H, W) bool or integers, zero outside the garment.
        confidence: (H, W) uint8, 255 is the highest.
        min_confidence: pixels of lower confidence are ignored.
        colors: (H, W, 3) uint8, red, green, blue, of what the pixels of the depth see.
        depth_scale: metres per unit of uint16 depth.
        codec: a name of :data:`DEPTH_CODECS`, for all three images; an image that it cannot encode, such as floats in png,
            is sent as "zstd".

    Raises:
        CodecError: an array has another shape or type, or the codec is unknown.
    """
    if codec not in DEPTH_CODECS:
        raise CodecError(field="depth_codec", expected=" or ".join(DEPTH_CODECS), got=repr(codec)[:80])
    depth = _image("depth", depth, np.typecodes["Float"] + "BH", "floats, uint16 or uint8")
    lens = checked_array("intrinsics", intrinsics, expected="fx, fy, cx, cy", columns=None, error=CodecError)
    if lens.shape != (4,):
        raise CodecError(field="intrinsics", expected="fx, fy, cx, cy", got=f"numbers of shape {lens.shape}")
    message = pb.DepthImage(height=depth.shape[0], width=depth.shape[1])
    message.intrinsics.fx, message.intrinsics.fy, message.intrinsics.cx, message.intrinsics.cy = lens.tolist()
    if pose is not None:
        message.pose.matrix.extend(_pose_rows(pose))
    if depth.dtype.kind == "f":
        message.encoding = pb.DEPTH_ENCODING_FLOAT32_METRES
        message.compression = DEPTH_CODECS[codec if codec in ("none", "zstd") else "zstd"]
        with np.errstate(over="ignore"):
            message.data = _compress(depth.astype("<f4"), message.compression)
    else:
        message.encoding = pb.DEPTH_ENCODING_UINT16_MILLIMETRES
        message.compression, message.depth_scale = DEPTH_CODECS[codec], depth_scale
        message.data = _compress(depth.astype("<u2"), message.compression)
    byte_codec = DEPTH_CODECS[codec if codec != "rvl" else "zstd"]
    if mask is not None:
        message.mask_compression = byte_codec
        mask = _image("mask", mask, np.typecodes["AllInteger"] + "?", "whole numbers or bools", depth.shape)
        message.mask = _compress((mask != 0).astype(np.uint8), byte_codec)
    if confidence is not None:
        if isinstance(min_confidence, bool) or min_confidence not in range(256):
            raise CodecError(field="min_confidence", expected="a whole number from 0 to 255", got=str(min_confidence)[:40])
        confidence = _image("confidence", confidence, "BH", "uint8 or uint16", depth.shape)
        if confidence.size and confidence.max() > 255:
            raise CodecError(field="confidence", expected="numbers up to 255, uint8", got=str(confidence.max()))
        message.confidence_compression, message.min_confidence = byte_codec, int(min_confidence)
        message.confidence = _compress(confidence.astype(np.uint8), byte_codec)
    if colors is not None:
        message.colors = checked_colors(colors, (*depth.shape, 3)).tobytes()
    return message


def require_image_within(image: pb.DepthImage, max_pixels: int) -> None:
    """Refuses an image with more pixels, or more encoded bytes, than the limit allows; nothing is decoded."""
    sizes = {name: len(getattr(image, name)) for name in ("data", "mask", "confidence", "colors")}
    require_image_size_within(image.width, image.height, sizes, max_pixels)


def require_image_size_within(width: int, height: int, sizes: Mapping[str, int], max_pixels: int) -> None:
    """As :func:`require_image_within`; ``sizes`` are the encoded bytes by the name of the field. Missing ones are small."""
    if not (width and height) or width * height > max_pixels:
        expected, got = f"1 to {max_pixels} pixels", f"{width} x {height}"
        raise CodecError(field="depth_image", expected=expected, got=got)
    max_bytes = _BYTES_PER_PIXEL * width * height + _HEADER_BYTES
    for name, size in sizes.items():
        if size > max_bytes:
            raise CodecError(field=f"depth_image.{name}", expected=f"at most {max_bytes} bytes", got=f"{size} bytes")


def decode_depth(image: pb.DepthImage, *, max_pixels: int) -> Depth:
    """Decodes a depth image.

    Args:
        image: the message, untrusted.
        max_pixels: the largest accepted width x height; decoding takes less than 200 bytes per pixel of it.

    Raises:
        CodecError: too many pixels, an unknown encoding, or invalid data.
        InvalidFrame: invalid intrinsics, pose or scale.
    """
    require_image_within(image, max_pixels)
    lens = _lens(image.intrinsics)
    pose = _rigid(pose_matrix(image.pose, "depth_image.pose"))
    shape = image.height, image.width
    depth = _depth(image, shape)
    keep = None
    if image.mask:
        keep = _decompress(image.mask, image.mask_compression, shape, np.dtype("u1"), "depth_image.mask") != 0
    if image.confidence:
        if image.min_confidence > 255:
            got = str(image.min_confidence)
            raise CodecError(field="depth_image.min_confidence", expected="at most 255", got=got)
        field = "depth_image.confidence"
        confidence = _decompress(image.confidence, image.confidence_compression, shape, np.dtype("u1"), field)
        certain = confidence >= max(image.min_confidence, 1)  # 0 is unusable
        keep = certain if keep is None else keep & certain
    colors = colors_of(image.colors, (*shape, 3), "depth_image.colors", "pixels")
    return Depth(depth, keep, lens, pose, colors)


def checked_scale(scale: float, field: str) -> float:
    """The metres per unit of a uint16 depth, which are at most one.

    Raises:
        InvalidFrame: another number, or none.
    """
    if not isinstance(scale, (int, float, np.integer, np.floating)) or not 0 < scale <= 1:
        raise InvalidFrame(field=field, expected="metres per unit, above 0 and at most 1", got=repr(scale)[:40])
    return scale


def _depth(image: pb.DepthImage, shape: tuple[int, int]) -> np.ndarray:
    field = "depth_image.data"
    if image.encoding == pb.DEPTH_ENCODING_FLOAT32_METRES:
        return _decompress(image.data, image.compression, shape, np.dtype("<f4"), field)
    if image.encoding == pb.DEPTH_ENCODING_UINT16_MILLIMETRES:
        scale = checked_scale(image.depth_scale or DEFAULT_SCALE, "depth_image.depth_scale")
        return _decompress(image.data, image.compression, shape, np.dtype("<u2"), field) * np.float32(scale)
    expected = "float32 metres or uint16 millimetres"
    raise CodecError(field="depth_image.encoding", expected=expected, got=f"encoding {image.encoding}")


def _compress(image: np.ndarray, compression: int) -> bytes:
    match compression:
        case pb.DEPTH_COMPRESSION_ZSTD:
            return compress.zstd_compress(image.tobytes())
        case pb.DEPTH_COMPRESSION_PNG:
            return png.compress(image)
        case pb.DEPTH_COMPRESSION_RVL:
            return rvl.compress(image)
    return image.tobytes()


def _decompress(data: bytes, compression: int, shape: tuple[int, int], dtype: np.dtype, field: str) -> np.ndarray:
    """The (H, W) image of this type. Its size in bytes is checked before memory is allocated."""
    size = shape[0] * shape[1] * dtype.itemsize

    def require_size(got: int) -> None:
        if got != size:
            raise CodecError(field=field, expected=f"{size} bytes for {shape[1]} x {shape[0]} pixels", got=f"{got} bytes")

    if compression in (pb.DEPTH_COMPRESSION_UNSPECIFIED, pb.DEPTH_COMPRESSION_NONE):
        require_size(len(data))
    elif compression == pb.DEPTH_COMPRESSION_ZSTD:
        data = compress.zstd_decompress(data, require_size, field)
    elif compression == pb.DEPTH_COMPRESSION_PNG and dtype.kind == "u":
        return png.decompress(data, shape, dtype, field)
    elif compression == pb.DEPTH_COMPRESSION_RVL and dtype == np.dtype("<u2"):
        return rvl.decompress(data, shape, field)
    else:
        known = compression in pb.DepthCompression.values()
        got = f"{pb.DepthCompression.Name(compression)} of {dtype.name}" if known else f"unknown compression {compression}"
        raise CodecError(field=field, expected="a compression of this kind of image", got=got)
    return np.frombuffer(data, dtype).reshape(shape)


def _lens(intrinsics: pb.Intrinsics) -> tuple[float, float, float, float]:
    lens = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    if not all(map(math.isfinite, lens)) or lens[0] <= 0 or lens[1] <= 0:
        raise InvalidFrame(field="depth_image.intrinsics", expected="finite numbers, fx and fy above 0", got=str(lens))
    return lens


def _rigid(pose: np.ndarray) -> np.ndarray:
    rotation = pose[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error <= _ROTATION_ERROR and np.linalg.det(rotation) > 0:
            return pose
    raise InvalidFrame(field="depth_image.pose.matrix", expected="[R | t] with R a rotation", got="R that is no rotation")


def _pose_rows(pose: np.ndarray) -> list[float]:
    pose = checked_array("pose", pose, expected="numbers of shape (3, 4) or (4, 4)", columns=None, error=CodecError)
    if pose.shape not in ((3, 4), (4, 4)):
        raise CodecError(field="pose", expected="shape (3, 4) or (4, 4)", got=str(pose.shape))
    if len(pose) == 4 and not np.allclose(pose[3], [0, 0, 0, 1], atol=_LAST_ROW_ERROR):  # as AR platforms write it, by columns
        raise CodecError(field="pose", expected="a last row of 0, 0, 0, 1", got=", ".join(f"{x:.6g}" for x in pose[3].tolist()))
    return pose[:3].ravel().tolist()


def _image(name: str, image: np.ndarray, types: str, named: str, shape: tuple[int, int] | None = None) -> np.ndarray:
    """The image, if it has this shape, and a type of these characters of NumPy, which errors call ``named``."""
    expected = f"{named} of shape {shape or '(H, W)'}"
    image = checked_array(name, image, expected=expected, kinds="biuf", columns=None, error=CodecError)
    if image.ndim == 2 and image.size and image.shape == (shape or image.shape) and image.dtype.char in types:
        return image
    raise CodecError(field=name, expected=expected, got=f"{image.dtype} of shape {image.shape}")

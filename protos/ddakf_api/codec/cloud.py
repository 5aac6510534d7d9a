"""Point-cloud codecs: arrays of points to ``PointCloud`` messages and back."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ddakf_api.codec import compress, draco, morton, planes
from ddakf_api.codec.colors import checked_colors, colors_of
from ddakf_api.codec.quantise import DEFAULT_STEP, dequantise, quantise, require_finite_range
from ddakf_api.errors import CodecError, Unimplemented
from ddakf_api.v1 import tracking_pb2 as pb

CODECS = {
    "raw": pb.POINT_CODEC_RAW_FLOAT32,
    "quantised": pb.POINT_CODEC_QUANTISED_16,
    "morton-zstd": pb.POINT_CODEC_MORTON_ZSTD,
    "morton-deflate": pb.POINT_CODEC_MORTON_DEFLATE,
    "draco": pb.POINT_CODEC_DRACO,
}
"""Codecs by the name in the API; draco needs the package dracopy."""

DEFAULT_CODEC = "morton-zstd"

_COMPRESS = {
    pb.POINT_CODEC_MORTON_ZSTD: compress.zstd_compress,
    pb.POINT_CODEC_MORTON_DEFLATE: compress.deflate_compress,
}
_DECOMPRESS = {
    pb.POINT_CODEC_MORTON_ZSTD: planes.zstd_decompress,
    pb.POINT_CODEC_MORTON_DEFLATE: planes.deflate_decompress,
}


class Encoded(NamedTuple):
    """A cloud ready to send.

    Attributes:
        cloud: the message.
        order: (N,) int64: point i of the decoded cloud is point ``order[i]`` of the given one. It permutes per-point data.
            None: the codec keeps the order.
    """

    cloud: pb.PointCloud
    order: np.ndarray | None


def encode(
    points: np.ndarray,
    codec: str = DEFAULT_CODEC,
    *,
    step: float = DEFAULT_STEP,
    runs: Sequence[int] | None = None,
    colors: np.ndarray | None = None,
) -> Encoded:
    """Encodes a cloud.

    Args:
        points: (N, 3) metres, finite; N may be 0.
        codec: a name of :data:`CODECS`.
        step: quantisation step, metres; the error is at most half of it per axis. Not used by ``raw``.
        runs: lengths of the consecutive runs of points, one per sensor; the encoded cloud keeps them. Default: one run.
        colors: (N, 3) uint8, red, green, blue; None: unknown.

    Raises:
        CodecError: the codec is unknown, the points are not finite numbers of shape (N, 3), their extent is too large for
            the step, the runs do not sum to N, or there is not one color per point.
    """
    if codec not in CODECS:
        raise CodecError(field="codec", expected=" or ".join(CODECS), got=repr(codec))
    points = _checked_points(points)
    runs = _checked_runs(runs, len(points))
    cloud = pb.PointCloud(codec=CODECS[codec], point_count=len(points))
    colors = None if colors is None else checked_colors(colors, points.shape)
    order = _fill(cloud, codec, points, step, runs)
    if colors is not None:
        cloud.colors = (colors if order is None else colors[order]).tobytes()
    cloud.crc32 = zlib.crc32(cloud.data)
    return Encoded(cloud, order)


def _fill(cloud: pb.PointCloud, codec: str, points: np.ndarray, step: float, runs: list[int]) -> np.ndarray | None:
    """Sets data, step and origin; returns the order of the points, or None if it is unchanged."""
    if codec == "raw":
        cloud.data = _as_float32(points).tobytes()
        return None
    if codec == "draco":
        if len(points) == 0:
            return np.empty(0, np.int64)
        cloud.data, order = draco.encode(points, step, runs)
        return order
    coordinates, origin = quantise(points, step, 16 if codec == "quantised" else morton.BITS)
    cloud.step = step
    cloud.origin.x, cloud.origin.y, cloud.origin.z = origin.tolist()
    if codec == "quantised":
        cloud.data = coordinates.T.astype("<u2", order="C").tobytes()
        return None
    codes, order = morton.sort_within_runs(morton.interleave(coordinates), runs)
    if len(points):
        cloud.data = _COMPRESS[cloud.codec](planes.to_planes(codes))
    return order


def decode(cloud: pb.PointCloud, *, max_points: int, draco_decoder: draco.Decoder | None = None) -> np.ndarray:
    """Decodes a cloud.

    Args:
        cloud: the message, untrusted.
        max_points: the largest accepted N; decoding takes less than about 100 bytes per point of it.
        draco_decoder: decoder of Draco clouds; None: they are refused.

    Returns:
        (N, 3) float64 metres, finite.

    Raises:
        CodecError: too many points, an unknown codec, invalid data, or data with another CRC-32 than the message says.
        Unimplemented: a Draco cloud, but no decoder.
    """
    count = cloud.point_count
    if count > max_points:
        raise CodecError(field="point_cloud.point_count", expected=f"at most {max_points} points", got=str(count))
    codec = cloud.codec or CODECS[DEFAULT_CODEC]
    if codec == pb.POINT_CODEC_DRACO and draco_decoder is None:
        raise Unimplemented("point_cloud.codec: Draco is not decoded here", field="point_cloud.codec")
    if codec not in CODECS.values():
        raise CodecError(field="point_cloud.codec", expected=" or ".join(CODECS), got=f"unknown codec {codec}")
    lengths = {pb.POINT_CODEC_RAW_FLOAT32: 12 * count, pb.POINT_CODEC_QUANTISED_16: 6 * count}
    if count == 0 or codec in lengths:
        _require_length(cloud.data, lengths.get(codec, 0))
    _require_checksum(cloud)
    if count == 0:
        return np.empty((0, 3))
    if codec == pb.POINT_CODEC_RAW_FLOAT32:
        return _decode_raw(cloud.data, count)
    if codec == pb.POINT_CODEC_DRACO:
        return draco_decoder.decode(cloud.data, count)
    origin = np.array([cloud.origin.x, cloud.origin.y, cloud.origin.z])
    step = cloud.step or DEFAULT_STEP
    if codec == pb.POINT_CODEC_QUANTISED_16:
        require_finite_range(origin, step, 16)
        return dequantise(np.frombuffer(cloud.data, "<u2").reshape(count, 3).T, origin, step)
    require_finite_range(origin, step, morton.BITS)
    codes = planes.from_planes(_DECOMPRESS[codec](cloud.data, count), count)
    return dequantise(morton.separate(codes), origin, step)


def decode_colors(cloud: pb.PointCloud) -> np.ndarray | None:
    """(N, 3) uint8 colors of a cloud that :func:`decode` accepts, red, green, blue; None: unknown.

    Raises:
        CodecError: not three bytes per point.
    """
    return colors_of(cloud.colors, (cloud.point_count, 3), "point_cloud.colors", "points")


def _decode_raw(data: bytes, count: int) -> np.ndarray:
    points = np.frombuffer(data, "<f4").reshape(count, 3)
    if not np.isfinite(points).all():
        bad = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
        raise CodecError(field="point_cloud.data", expected="finite positions", got=f"{bad} points that are not")
    return points.astype(np.float64)  # after the check: NumPy warns when it converts a signalling NaN


def _require_checksum(cloud: pb.PointCloud) -> None:
    """Detects damage that no codec notices; without a checksum in the message nothing is checked."""
    if not cloud.HasField("crc32") or (actual := zlib.crc32(cloud.data)) == cloud.crc32:
        return
    expected, got = f"CRC-32 {cloud.crc32:08x}", f"{actual:08x}"
    message = f"payload point_cloud.data of {len(cloud.data)} bytes: expected {expected}, got {got}"
    raise CodecError(message, field="point_cloud.data", expected=expected, got=got)


def _require_length(data: bytes, expected: int) -> None:
    if len(data) != expected:
        raise CodecError(
            field="point_cloud.data", expected=f"{expected} bytes for point_count points", got=f"{len(data)} bytes"
        )


def _checked_points(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        got = f"{points.dtype} of shape {points.shape}"
        raise CodecError(field="points", expected="numbers of shape (N, 3)", got=got)
    return points


def _checked_runs(runs: Sequence[int] | None, count: int) -> list[int]:
    if runs is None:
        return [count]
    if any(length < 0 for length in runs) or sum(runs) != count:
        raise CodecError(field="runs", expected=f"lengths that sum to {count} points", got=str(list(runs))[:80])
    return list(runs)


def _as_float32(points: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        narrow = points.astype("<f4", order="C")
    finite = np.isfinite(narrow)
    if not finite.all():
        got = f"{int(np.count_nonzero(~finite.all(axis=1)))} of {len(points)} points that are not"
        raise CodecError(field="points", expected="finite positions within float32", got=got)
    return narrow

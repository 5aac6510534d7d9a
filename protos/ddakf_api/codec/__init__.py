"""Codecs of point clouds and depth images, written once for server and client.

    encoded = encode(points)                      # Morton order and zstd, half a millimetre per step
    points = decode(encoded.cloud, max_points=100_000)
    image = encode_depth(depth, (fx, fy, cx, cy), pose=T_world_camera)
    depth = decode_depth(image, max_pixels=1_000_000)

A decoder trusts no input. It compares counts with the limit, and declared sizes with the count, before it allocates memory.
Any input gives points or a :class:`~ddakf_api.errors.CodecError`.
"""

from ddakf_api.codec.cloud import CODECS, DEFAULT_CODEC, Encoded, decode, decode_colors, encode
from ddakf_api.codec.depth import (
    DEFAULT_DEPTH_CODEC,
    DEFAULT_SCALE,
    DEPTH_CODECS,
    Depth,
    decode_depth,
    encode_depth,
    require_image_size_within,
    require_image_within,
)
from ddakf_api.codec.draco import Decoder as DracoDecoder
from ddakf_api.codec.quantise import DEFAULT_STEP
from ddakf_api.codec.sensors import group_by_sensor, require_few_sensors, require_sensor_count, sensor_origins

__all__ = [
    "CODECS",
    "DEFAULT_CODEC",
    "DEFAULT_DEPTH_CODEC",
    "DEFAULT_SCALE",
    "DEFAULT_STEP",
    "DEPTH_CODECS",
    "Depth",
    "DracoDecoder",
    "Encoded",
    "decode",
    "decode_colors",
    "decode_depth",
    "encode",
    "encode_depth",
    "group_by_sensor",
    "require_few_sensors",
    "require_image_size_within",
    "require_image_within",
    "require_sensor_count",
    "sensor_origins",
]

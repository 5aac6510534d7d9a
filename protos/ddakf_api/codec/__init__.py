"""Point-cloud codecs, written once for server and client: points to ``PointCloud`` messages and back.

    encoded = encode(points)                      # Morton order and zstd, half a millimetre per step
    points = decode(encoded.cloud, max_points=100_000)

Decoding trusts nothing: counts are compared with the limit, and sizes that a payload declares with its count, before
memory is taken for them; whatever the bytes are, the answer is points or a :class:`~ddakf_api.errors.CodecError`.
"""

from ddakf_api.codec.cloud import CODECS, DEFAULT_CODEC, Encoded, decode, encode
from ddakf_api.codec.quantise import DEFAULT_STEP
from ddakf_api.codec.sensors import group_by_sensor, sensor_origins

__all__ = [
    "CODECS",
    "DEFAULT_CODEC",
    "DEFAULT_STEP",
    "Encoded",
    "decode",
    "encode",
    "group_by_sensor",
    "sensor_origins",
]

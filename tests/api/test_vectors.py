"""Shared vectors: they are what the Python codecs write, and the TypeScript client's payloads decode to the same bits."""

import base64
import importlib.util
import zlib
from pathlib import Path

import numpy as np
import pytest
from ddakf_api.codec import decode, decode_colors, decode_depth
from ddakf_api.v1 import tracking_pb2 as pb

VECTORS = Path(__file__).resolve().parents[2] / "protos/vectors"
SPEC = importlib.util.spec_from_file_location("shared_vectors", VECTORS / "generate.py")
vectors = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(vectors)

TYPESCRIPT = {vector["name"]: vector for vector in vectors.committed("typescript")}


def test_the_vectors_are_up_to_date():
    assert vectors.stale_files() == [], "run python protos/vectors/generate.py"


@pytest.mark.parametrize("vector", vectors.committed("clouds"), ids=lambda vector: vector["name"])
def test_a_cloud_that_typescript_encoded_decodes_to_the_same_bits(vector):
    written = TYPESCRIPT.pop(vector["name"])
    data = base64.b64decode(written["data"])
    x, y, z = written["origin"]
    cloud = pb.PointCloud(
        codec=pb.PointCodec.Value(f"POINT_CODEC_{written['codec']}"),
        point_count=len(base64.b64decode(vector["decoded"])) // 24,
        data=data,
        step=written["step"],
        origin=pb.Vector3(x=x, y=y, z=z),
        crc32=written["crc32"],
        colors=base64.b64decode(written["colors"]),
    )
    assert decode(cloud, max_points=1000).tobytes() == base64.b64decode(vector["decoded"])
    colors = decode_colors(cloud)
    assert (b"" if colors is None else colors.tobytes()) == base64.b64decode(vector["decoded_colors"])
    if vector["inflated"]:
        assert zlib.decompress(data) == base64.b64decode(vector["inflated"])
    else:
        assert data == base64.b64decode(vector["data"])


@pytest.mark.parametrize("vector", vectors.committed("depth_images"), ids=lambda vector: vector["name"])
def test_a_depth_image_that_typescript_encoded_decodes_to_the_same_bits(vector):
    written = TYPESCRIPT.pop(vector["name"])
    message = pb.DepthImage(
        encoding=pb.DEPTH_ENCODING_UINT16_MILLIMETRES,
        compression=pb.DEPTH_COMPRESSION_RVL,
        width=vector["width"],
        height=vector["height"],
        data=base64.b64decode(written["data"]),
        intrinsics=pb.Intrinsics(fx=1, fy=1),
        depth_scale=1.0,
        mask=base64.b64decode(written["mask"]),
        mask_compression=pb.DEPTH_COMPRESSION_PNG,
        colors=base64.b64decode(written["colors"]),
    )
    depth = decode_depth(message, max_pixels=10_000)
    assert depth.depth.astype("<u2").tobytes() == base64.b64decode(vector["pixels"])
    assert depth.keep.astype(np.uint8).tobytes() == base64.b64decode(vector["mask"])
    assert depth.colors.tobytes() == base64.b64decode(vector["colors"])
    assert written["data"] == vector["data"]

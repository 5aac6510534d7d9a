"""Shared vectors: inputs and outputs of the Python codecs, which the clients of other languages reproduce bit for bit.

    python protos/vectors/generate.py            # after a change of a codec or an error
    python protos/vectors/generate.py --check    # exit 1 and name the files that differ

``typescript.json`` has the same inputs as encoded by the TypeScript client (``npm run vectors`` in clients/typescript).
Compressed payloads depend on the version of zlib; the check compares what they hold.
"""

from __future__ import annotations

import argparse
import base64
import json
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from ddakf_api.arrays import pack, unpack
from ddakf_api.codec import DEFAULT_STEP, decode, encode, encode_depth
from ddakf_api.errors import ERRORS
from ddakf_api.v1 import tracking_pb2 as pb

HERE = Path(__file__).resolve().parent
CLOUD_CODECS = ("raw", "quantised", "morton-deflate")


def base64_of(data: bytes) -> str:
    return base64.b64encode(data).decode()


def clouds() -> list[dict[str, Any]]:
    """Clouds in the codecs of a browser: points, options, and the message."""
    rng = np.random.default_rng(18)
    shirt = rng.normal((0.1, 1.2, -2.0), (0.3, 0.4, 0.1), (150, 3))
    wide = rng.uniform(-500.0, 500.0, (60, 3))
    cases: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
        "empty": (np.empty((0, 3)), {}),
        "one point": (np.array([[-1.5, 0.25, 3.0]]), {}),
        "float64": (shirt, {}),
        "float32": (shirt.astype(np.float32), {}),
        "three sensors": (shirt.astype(np.float32), {"runs": [40, 0, 110]}),
        "equal points": (np.repeat(shirt[:20], 3, axis=0), {}),
        "halves of a step": (np.arange(60.0).reshape(20, 3) * 0.25, {"step": 0.5}),
        "63 bits": (wide, {}),
        "one plane": (shirt[:30] * 0.001, {}),
        "two planes, fine step": (shirt[:30] * 0.001, {"step": 1e-4}),
    }
    vectors = []
    for name, (points, options) in cases.items():
        for codec in CLOUD_CODECS:
            if codec == "quantised" and name == "63 bits":
                continue  # beyond 16 bits
            vectors.append({"name": f"{name}, {codec}", **cloud(points, codec, **options)})
    return vectors


def cloud(points: np.ndarray, codec: str, *, step: float = DEFAULT_STEP, runs: list[int] | None = None) -> dict[str, Any]:
    colors = np.random.default_rng(len(points)).integers(0, 256, points.shape, np.uint8)
    message, order = encode(points, codec, step=step, runs=runs, colors=colors)
    deflated = codec == "morton-deflate" and message.data
    return {
        "codec": codec,
        "step": step,
        "runs": runs,
        "dtype": str(points.dtype),
        "points": base64_of(points.tobytes()),
        "colors": base64_of(colors.tobytes()),
        "data": base64_of(message.data),
        "inflated": base64_of(zlib.decompress(message.data)) if deflated else None,
        "origin": [message.origin.x, message.origin.y, message.origin.z],
        "crc32": message.crc32,
        "order": None if order is None else order.tolist(),
        "decoded": base64_of(decode(message, max_points=len(points)).tobytes()),
        "decoded_colors": base64_of(message.colors),
    }


def depth_images() -> list[dict[str, Any]]:
    """16-bit depth images in RVL, and a mask in PNG."""
    rng = np.random.default_rng(19)
    surface = np.rint(1500 + 200 * np.sin(np.arange(24 * 32).reshape(24, 32) / 40)).astype(np.uint16)
    images = {
        "surface": surface,
        "surface with holes": surface * (rng.random(surface.shape) > 0.3),
        "nothing": np.zeros((4, 8), np.uint16),
        "one pixel": np.full((1, 1), 65535, np.uint16),
        "extremes": np.tile(np.array([65535, 0, 1, 65535, 32768], np.uint16), 8).reshape(5, 8),
        "noise": rng.integers(0, 65536, (9, 7)).astype(np.uint16),
    }
    vectors = []
    for name, image in images.items():
        mask, colors = image > np.median(image), rng.integers(0, 256, (*image.shape, 3), np.uint8)
        message = encode_depth(image.astype(np.uint16), (1, 1, 0, 0), mask=mask, colors=colors, codec="rvl")
        vectors.append(
            {
                "name": name,
                "width": image.shape[1],
                "height": image.shape[0],
                "pixels": base64_of(image.astype("<u2").tobytes()),
                "mask": base64_of(mask.astype(np.uint8).tobytes()),
                "colors": base64_of(message.colors),
                "data": base64_of(message.data),
            }
        )
    return vectors


def arrays() -> list[dict[str, Any]]:
    """Packed arrays of results in every encoding of floats."""
    rng = np.random.default_rng(20)
    positions = rng.normal((0.1, 1.2, -2.0), 0.4, (50, 3))
    scalars = np.concatenate([rng.uniform(0, 1, 60), [0.0, 1.0, 6e-8, 6e-5, 2.0**-14, 65504.0, np.inf]])
    cases = {
        "float32": pack(positions),
        "float64": pack(positions, pb.ARRAY_ENCODING_FLOAT64),
        "quantised, 16 bits": pack(positions, pb.ARRAY_ENCODING_QUANTISED_16),
        "quantised with a step": pack(positions, pb.ARRAY_ENCODING_QUANTISED_16, step=3e-5),
        "quantised scalars, 8 bits": pack(scalars[:60], pb.ARRAY_ENCODING_QUANTISED_8),
        "float16": pack(scalars, pb.ARRAY_ENCODING_FLOAT16),
    }
    vectors = []
    for name, packed in cases.items():
        components = None if packed.encoding in (pb.ARRAY_ENCODING_FLOAT16, pb.ARRAY_ENCODING_QUANTISED_8) else 3
        values = unpack(packed, components, field=name, max_items=1000).astype("<f4")
        message = base64_of(packed.SerializeToString())
        vectors.append({"name": name, "components": components or 1, "message": message, "values": base64_of(values.tobytes())})
    return vectors


def errors() -> list[dict[str, Any]]:
    """Errors in their order: name, base, HTTP status, whether to try again."""
    return [
        {"name": name, "base": cls.__bases__[0].__name__, "http": cls.http_status, "retryable": cls.retryable}
        for name, cls in ERRORS.items()
    ]


VECTORS = {"clouds": clouds, "depth_images": depth_images, "arrays": arrays, "errors": errors}


def text_of(vectors: list[dict[str, Any]]) -> str:
    lines = ",\n".join(json.dumps(vector) for vector in vectors)
    return f"[\n{lines}\n]\n"


def committed(name: str) -> list[dict[str, Any]]:
    """The vectors of a file."""
    return json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))


def stale_files() -> list[str]:
    """Names of files that are not what the codecs write, compressed payloads excepted."""
    return [name for name, make in VECTORS.items() if without_compressed(committed(name)) != without_compressed(make())]


def without_compressed(vectors: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Vectors without the payload that zlib wrote, and its checksum."""
    compressed = ("data", "crc32")
    return [
        {key: value for key, value in vector.items() if not (vector.get("inflated") and key in compressed)} for vector in vectors
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 when the committed files differ")
    if parser.parse_args().check:
        stale = stale_files()
        for name in stale:
            print(f"{name}.json is out of date: run python protos/vectors/generate.py", file=sys.stderr)
        return 1 if stale else 0
    for name, make in VECTORS.items():
        (HERE / f"{name}.json").write_text(text_of(make()), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

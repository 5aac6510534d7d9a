"""Point caches: the vertices of every frame of an animation, in 32-bit (.pc2) or 16-bit floats (.pc16, CLOTH3D's own).

Little endian: 12 bytes ``POINTCACHE2\\0``, int32 version, int32 vertices, float32 first frame, float32 sample rate, int32 frames,
then frames x vertices x 3 floats. Halves are 0.5 mm apart between 0.5 and 1 m, 1 mm up to 2 m.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile

HEADER = struct.Struct("<12siiffi")
SIGNATURE = b"POINTCACHE2\0"
FLOATS = {".pc2": "<f4", ".pc16": "<f2"}


def read_point_cache(path) -> np.ndarray:
    """Reads a point cache.

    Returns:
        (T, V, 3) float32, in its units.

    Raises:
        InvalidFile: no such file, not a point cache, not as long as its header says, non-finite numbers.
    """
    path = Path(path)
    if path.suffix.lower() not in FLOATS or not path.is_file():
        raise InvalidFile(str(path), f"a point cache ({' or '.join(FLOATS)})", "nothing of the kind")
    data = path.read_bytes()
    if len(data) < HEADER.size or not data.startswith(SIGNATURE):
        raise InvalidFile(path.name, f"a header of {HEADER.size} bytes from {SIGNATURE!r}", repr(data[:12]))
    _, _, vertices, _, _, frames = HEADER.unpack_from(data)
    kind = np.dtype(FLOATS[path.suffix.lower()])
    expected = HEADER.size + frames * vertices * 3 * kind.itemsize
    if frames < 1 or vertices < 1 or len(data) != expected:
        raise InvalidFile(path.name, f"{expected} bytes for {frames} frames of {vertices} vertices", f"{len(data)}")
    values = np.frombuffer(data, kind, offset=HEADER.size).reshape(frames, vertices, 3).astype(np.float32)
    if not np.isfinite(values).all():
        raise InvalidFile(path.name, "finite numbers", f"{(~np.isfinite(values)).sum()} non-finite")
    return values

"""Packed arrays: NumPy arrays to ``PackedArray`` messages and back. Lengths are checked before memory is allocated."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ddakf_api.errors import InvalidArgument, InvalidMesh, first_line
from ddakf_api.v1 import tracking_pb2 as pb

FLOATS = (pb.ARRAY_ENCODING_FLOAT32, pb.ARRAY_ENCODING_FLOAT64)

_DTYPES = {
    pb.ARRAY_ENCODING_FLOAT32: np.dtype("<f4"),
    pb.ARRAY_ENCODING_FLOAT64: np.dtype("<f8"),
    pb.ARRAY_ENCODING_FLOAT16: np.dtype("<f2"),
    pb.ARRAY_ENCODING_QUANTISED_16: np.dtype("<u2"),
    pb.ARRAY_ENCODING_QUANTISED_8: np.dtype("u1"),
    pb.ARRAY_ENCODING_INT32: np.dtype("<i4"),
    pb.ARRAY_ENCODING_UINT32: np.dtype("<u4"),
    pb.ARRAY_ENCODING_BOOL: np.dtype("u1"),
}
_QUANTISED = (pb.ARRAY_ENCODING_QUANTISED_16, pb.ARRAY_ENCODING_QUANTISED_8)


def checked_array(
    field: str,
    values: object,
    *,
    expected: str,
    kinds: str = "fiu",
    columns: int | None = 3,
    error: type[InvalidArgument] = InvalidArgument,
) -> np.ndarray:
    """Converts an argument of a caller to an array.

    Args:
        field: name of the argument in errors.
        expected: description of a valid argument, for errors.
        kinds: allowed kinds of dtype.
        columns: required shape (n, columns); None: any shape.
        error: class of the raised error.

    Raises:
        InvalidArgument: the argument cannot be converted (rows of unequal lengths), has another shape or type, or is a masked
            array, whose mask the conversion would drop.
    """
    if isinstance(values, np.ma.MaskedArray):
        raise error(field=field, expected=f"{expected}, without a mask of NumPy", got="a masked array")
    try:
        array = np.asarray(values)
    except Exception as cause:  # of NumPy or of the object's own conversion
        reason = "rows of unequal lengths" if "inhomogeneous" in str(cause) else first_line(cause)
        got = f"{type(values).__name__} that is no array ({reason})"
        raise error(field=field, expected=expected, got=got) from None
    has_shape = columns is None or (array.ndim == 2 and array.shape[1] == columns)
    if not has_shape or array.dtype.kind not in kinds:
        got = f"{array.dtype} of shape {array.shape}" if array.ndim else type(values).__name__
        raise error(field=field, expected=expected, got=got)
    return array


def pack(array: np.ndarray, encoding: int = pb.ARRAY_ENCODING_FLOAT32, *, step: float | None = None) -> pb.PackedArray:
    """Packs an array of shape (n,) or (n, components).

    Quantised encodings need finite values; their error is at most half a step. Without a `step`, the steps cover the range of
    the array: the error is at most the range of the largest component divided by 131,070 (16 bit) or 510 (8 bit).

    Args:
        step: of quantised encodings, in the unit of the array; doubled until the range fits. Values are rounded to multiples
            of it, so that a value that does not change between arrays is encoded the same.
    """
    dtype = _DTYPES[encoding]
    if encoding not in _QUANTISED:
        return pb.PackedArray(encoding=encoding, data=np.ascontiguousarray(array, dtype=dtype).tobytes())
    values = np.asarray(array, dtype=np.float64)
    columns = values.reshape(len(values), -1) if values.size else np.zeros((1, *values.shape[1:])).reshape(1, -1)
    low, high = columns.min(axis=0), columns.max(axis=0)
    if step is None:
        step = float((high - low).max()) / np.iinfo(dtype).max or 1.0
    else:
        while (np.rint(high / step) - np.rint(low / step)).max() > np.iinfo(dtype).max:
            step *= 2
        low = step * np.rint(low / step)
    data = np.rint((values - low) / step).astype(dtype).tobytes()
    return pb.PackedArray(encoding=encoding, data=data, offset=low, step=step)


def unpack(
    packed: pb.PackedArray,
    components: int | None = None,
    *,
    field: str,
    max_items: int,
    encodings: Sequence[int] = tuple(_DTYPES),
    error: type[InvalidArgument] = InvalidArgument,
) -> np.ndarray:
    """Unpacks a message to an array of shape (n,), or (n, components) if `components` is given.

    16-bit floats and quantised values become float32, other values keep their type. Arrays are writable and of native byte
    order.

    Args:
        field: name of the field in errors.
        max_items: the largest n.
        encodings: allowed encodings.
        error: class of the raised error.

    Raises:
        InvalidArgument: another encoding, a length that is not a multiple of the item size, or too many items.
    """
    if packed.encoding not in encodings:
        names = " or ".join(pb.ArrayEncoding.Name(e) for e in encodings)
        raise error(field=f"{field}.encoding", expected=names, got=_encoding_name(packed.encoding))
    dtype = _DTYPES[packed.encoding]
    item_bytes = dtype.itemsize * (components or 1)
    items, rest = divmod(len(packed.data), item_bytes)
    if rest:
        got = f"{len(packed.data)} bytes"
        raise error(field=f"{field}.data", expected=f"a multiple of {item_bytes} bytes", got=got)
    if items > max_items:
        raise error(field=field, expected=f"at most {max_items} items", got=str(items))
    raw = np.frombuffer(packed.data, dtype).reshape((items,) if components is None else (items, components))
    if packed.encoding in _QUANTISED:
        return (_offset(packed, components or 1, field, error) + packed.step * raw).astype(np.float32)
    if packed.encoding == pb.ARRAY_ENCODING_BOOL:
        return raw != 0
    if packed.encoding == pb.ARRAY_ENCODING_FLOAT16:
        with np.errstate(invalid="ignore"):  # NumPy warns of a signalling NaN
            return raw.astype(np.float32)
    return raw.astype(dtype.newbyteorder("="))


def pack_mesh(vertices: np.ndarray, faces: np.ndarray, *, field: str = "mesh") -> pb.Mesh:
    """Packs a mesh of (V, 3) metres and (F, 3) indices. Vertices are float64, so that the server has the same mesh.

    Raises:
        InvalidMesh: an array has another shape or type, or an index is out of range.
    """
    vertices = checked_array(f"{field}.vertices", vertices, expected="numbers of shape (V, 3)", error=InvalidMesh)
    expected = "integers of shape (F, 3)"
    faces = checked_array(f"{field}.faces", faces, expected=expected, kinds="iu", error=InvalidMesh)
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        got = f"{faces.min()} to {faces.max()}"
        raise InvalidMesh(field=f"{field}.faces", expected=f"indices from 0 to {len(vertices) - 1}", got=got)
    return pb.Mesh(vertices=pack(vertices, pb.ARRAY_ENCODING_FLOAT64), faces=pack(faces, pb.ARRAY_ENCODING_UINT32))


def unpack_mesh(mesh: pb.Mesh, *, field: str, max_vertices: int, max_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Unpacks a mesh to (V, 3) float64 metres and (F, 3) int64. The tracker checks its topology.

    Raises:
        InvalidMesh: an invalid encoding or length, or too many vertices or faces.
    """
    vertices = unpack(
        mesh.vertices, 3, field=f"{field}.vertices", max_items=max_vertices, encodings=FLOATS, error=InvalidMesh
    )
    indices = (pb.ARRAY_ENCODING_UINT32,)
    faces = unpack(mesh.faces, 3, field=f"{field}.faces", max_items=max_faces, encodings=indices, error=InvalidMesh)
    return vertices.astype(np.float64), faces.astype(np.int64)


def _offset(packed: pb.PackedArray, components: int, field: str, error: type[InvalidArgument]) -> np.ndarray:
    offset = np.array(packed.offset)
    if len(offset) != components or not np.isfinite(offset).all():
        got = f"{len(offset)} of them" if len(offset) != components else "a number that is not finite"
        raise error(field=f"{field}.offset", expected=f"{components} finite numbers", got=got)
    if not (math.isfinite(packed.step) and packed.step > 0):
        raise error(field=f"{field}.step", expected="a finite number above 0", got=repr(packed.step))
    return offset


def _encoding_name(encoding: int) -> str:
    return pb.ArrayEncoding.Name(encoding) if encoding in pb.ArrayEncoding.values() else f"unknown encoding {encoding}"

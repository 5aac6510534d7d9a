"""Packed arrays: every encoding round-trips, and lengths are checked first."""

import numpy as np
import pytest
from ddakf_api.arrays import FLOATS, checked_array, pack, pack_mesh, unpack, unpack_mesh
from ddakf_api.errors import InvalidArgument, InvalidMesh
from ddakf_api.v1 import tracking_pb2 as pb

VALUES = np.random.default_rng(0).uniform(-1, 1, (50, 3))


@pytest.mark.parametrize(
    ("encoding", "tolerance"),
    [("FLOAT64", 0), ("FLOAT32", 6e-8), ("FLOAT16", 5e-4), ("QUANTISED_16", 2 / 131_070), ("QUANTISED_8", 2 / 510)],
)
@pytest.mark.parametrize("values", [VALUES, VALUES[:, 0], VALUES[:0], VALUES[:0, 0], np.full((4, 3), 7.25)])
def test_numbers_round_trip(values, encoding, tolerance):
    encoding = pb.ArrayEncoding.Value(f"ARRAY_ENCODING_{encoding}")
    components = 3 if values.ndim == 2 else None
    back = unpack(pack(values, encoding), components, field="a", max_items=50)
    assert back.shape == values.shape
    assert np.abs(back - values).max(initial=0) <= tolerance * 1.01
    assert back.flags.writeable


def test_booleans_and_integers_round_trip():
    flags = VALUES[:, 0] > 0
    assert np.array_equal(unpack(pack(flags, pb.ARRAY_ENCODING_BOOL), field="a", max_items=50), flags)
    indices = np.array([0, 5, 2**32 - 1])
    back = unpack(pack(indices, pb.ARRAY_ENCODING_UINT32), field="a", max_items=3)
    assert np.array_equal(back, indices)
    assert back.dtype == np.uint32


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (pb.PackedArray(encoding=1, data=bytes(13)), "a.data: expected a multiple of 12 bytes, got 13 bytes"),
        (pb.PackedArray(encoding=1, data=bytes(120)), "a: expected at most 5 items, got 10"),
        (pb.PackedArray(encoding=6, data=bytes(12)), "got ARRAY_ENCODING_INT32"),
        (pb.PackedArray(encoding=99, data=bytes(12)), "got unknown encoding 99"),
        (pb.PackedArray(data=bytes(12)), "got ARRAY_ENCODING_UNSPECIFIED"),
    ],
)
def test_invalid_messages_are_refused(message, said):
    with pytest.raises(InvalidArgument) as refusal:
        unpack(message, 3, field="a", max_items=5, encodings=FLOATS)
    assert said in str(refusal.value)


@pytest.mark.parametrize(
    "message",
    [
        pb.PackedArray(encoding=4, data=bytes(6), step=1, offset=[0]),
        pb.PackedArray(encoding=4, data=bytes(6), step=1, offset=[0, 0, float("nan")]),
        pb.PackedArray(encoding=4, data=bytes(6), step=0, offset=[0, 0, 0]),
    ],
)
def test_quantised_arrays_need_offset_and_step(message):
    with pytest.raises(InvalidArgument):
        unpack(message, 3, field="a", max_items=5)


def test_meshes_round_trip_exactly():
    faces = np.array([[0, 1, 2], [2, 1, 49]])
    message = pb.Mesh.FromString(pack_mesh(VALUES, faces).SerializeToString())
    vertices, back = unpack_mesh(message, field="garment", max_vertices=50, max_faces=2)
    assert np.array_equal(vertices, VALUES)
    assert np.array_equal(back, faces)
    with pytest.raises(InvalidMesh, match=r"garment.faces: expected at most 1 items, got 2"):
        unpack_mesh(message, field="garment", max_vertices=50, max_faces=1)


@pytest.mark.parametrize(
    ("vertices", "faces", "said"),
    [
        (VALUES, [[0, 1, 50]], "indices from 0 to 49"),
        (VALUES, [[0, 1, -1]], "indices from 0 to 49"),
        (VALUES, [[0.0, 1.0, 2.0]], "integers of shape (F, 3)"),
        (VALUES[:, :2], [[0, 1, 2]], "numbers of shape (V, 3)"),
        ([[0, 0, 0], [1, 0]], [[0, 1, 2]], "mesh.vertices: expected numbers of shape (V, 3), got list that is no array"),
        ([["a", "b", "c"]], [[0, 0, 0]], "mesh.vertices: expected numbers of shape (V, 3), got <U1 of shape (1, 3)"),
    ],
)
def test_invalid_meshes_are_not_sent(vertices, faces, said):
    with pytest.raises(InvalidMesh) as refusal:
        pack_mesh(vertices, np.array(faces))
    assert said in str(refusal.value)


def test_ragged_faces_are_not_sent():
    with pytest.raises(InvalidMesh, match=r"^mesh.faces: .* that is no array \(rows of unequal lengths\)$") as refusal:
        pack_mesh(VALUES, [[0, 1, 2], [0, 1]])
    assert refusal.value.field == "mesh.faces"


def test_an_error_of_the_array_conversion_becomes_an_invalid_argument():
    class OnAnotherDevice:
        def __array__(self, dtype=None, copy=None):
            raise TypeError("copy it to the host first\nand more")

    with pytest.raises(InvalidArgument, match=r"got OnAnotherDevice that is no array \(copy it to the host first\)$"):
        checked_array("points", OnAnotherDevice(), expected="numbers")

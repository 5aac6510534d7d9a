"""MATLAB files: files that SciPy writes give the same arrays, and damaged files are refused."""

import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from ddakf.errors import InvalidFile
from ddakf.evaluation.datasets.formats import matlab
from ddakf.evaluation.datasets.formats.matlab import read_arrays

RNG = np.random.default_rng(0)
ARRAYS = {
    "depth": RNG.integers(0, 4000, (4, 5, 3)).astype(np.uint16),
    "poses": RNG.normal(size=(72, 7)),
    "single": RNG.normal(size=(2, 3)).astype(np.float32),
    "signed": np.array([[-5, 7, -128]], np.int8),
    "long": np.array([[2**40, -3]]),
    "scalar": 0.7,
    "flag": 1,
    "row": np.arange(10.0),
    "empty": np.zeros((0, 3)),
}
OTHERS = {
    "outfit": {"Tshirt": {"fabric": "cotton"}},
    "text": "words",
    "complex": np.array([[1j]]),
    "cell": np.array([1, "a"], object),
}


@pytest.mark.parametrize("packed", [False, True])
def test_arrays_are_those_that_scipy_reads(tmp_path, packed):
    savemat(tmp_path / "a.mat", ARRAYS | OTHERS, do_compression=packed)
    expected = loadmat(tmp_path / "a.mat")
    read = read_arrays(tmp_path / "a.mat", [*ARRAYS, *OTHERS, "none"])
    assert set(read) == set(ARRAYS)
    for name in ARRAYS:
        assert read[name].dtype == expected[name].dtype
        assert np.array_equal(read[name], expected[name])
    assert set(read_arrays(tmp_path / "a.mat", ["poses"])) == {"poses"}


def _element(kind, content, order="<"):
    return struct.pack(f"{order}II", kind, len(content)) + content + bytes(-len(content) % 8)


def _file(matrix, order="<"):
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(f"{order}H", 0x0100) + (b"IM" if order == "<" else b"MI") + matrix


def test_files_of_the_other_byte_order_are_read(tmp_path):
    parts = _element(6, struct.pack(">II", 6, 0), ">") + _element(5, struct.pack(">ii", 1, 3), ">") + _element(1, b"abcde", ">")
    matrix = _element(14, parts + _element(3, struct.pack(">hhh", 1, -2, 3), ">"), ">")
    (tmp_path / "a.mat").write_bytes(_file(matrix, ">"))
    read = read_arrays(tmp_path / "a.mat", ["abcde"])["abcde"]
    assert np.array_equal(read, [[1, -2, 3]])
    assert read.dtype == np.int16


@pytest.mark.parametrize("packed", [False, True])
def test_damaged_files_are_read_or_refused(tmp_path, packed):
    path = tmp_path / "a.mat"
    savemat(path, {"depth": ARRAYS["depth"], "zrot": 0.7} | OTHERS, do_compression=packed)
    good, refused = path.read_bytes(), 0
    changes = [(at, value) for at in range(len(good)) for value in {good[at] ^ 1, good[at] ^ 0x80, 0xFF} - {good[at]}]
    changed = (good[:at] + bytes([value]) + good[at + 1 :] for at, value in changes)
    for data in [*changed, *(good[:length] for length in range(0, len(good), 7))]:
        path.write_bytes(data)
        try:
            read = read_arrays(path, ["depth", "zrot"])
        except InvalidFile:
            refused += 1
        else:
            assert all(array.ndim >= 2 for array in read.values())
    assert refused > 100


def test_an_array_that_grows_beyond_all_bounds_is_refused_before_it_does(tmp_path, monkeypatch):
    monkeypatch.setattr(matlab, "MOST_BYTES", 1 << 20)
    bomb = zlib.compress(bytes(1 << 26))
    (tmp_path / "a.mat").write_bytes(_file(struct.pack("<II", 15, len(bomb)) + bomb))
    tracemalloc.start()
    with pytest.raises(InvalidFile, match="beyond 1048576 bytes"):
        read_arrays(tmp_path / "a.mat", ["a"])
    assert tracemalloc.get_traced_memory()[1] < 1 << 23
    tracemalloc.stop()


def test_what_is_no_such_file_is_said(tmp_path):
    with pytest.raises(InvalidFile, match="nothing there"):
        read_arrays(tmp_path / "none.mat", ["a"])
    with pytest.raises(InvalidFile, match="a folder"):
        read_arrays(tmp_path, ["a"])
    for data in (b"", b"\x89HDF\r\n", b"text " * 99):
        (tmp_path / "a.mat").write_bytes(data)
        with pytest.raises(InvalidFile, match="version 5"):
            read_arrays(tmp_path / "a.mat", ["a"])

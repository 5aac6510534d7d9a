"""Readers and writers: what is written is read back; every malformed file gives one sentence that names the field."""

import builtins
import contextlib
import struct

import numpy as np
import pytest

from ddakf.data import SAMPLE, sample
from ddakf.data.pack import main as pack_main
from ddakf.data.pack import pack
from ddakf.data.pack_body import main as pack_body_main
from ddakf.errors import DdakfError, InvalidFile, MissingDependency
from ddakf.files import io, open3d_bridge

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_written_meshes_are_read_back(tmp_path, suffix):
    vertices = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    faces = np.random.default_rng(1).integers(0, 50, (80, 3))
    io.write_mesh(tmp_path / f"mesh{suffix}", vertices, faces)
    read_vertices, read_faces = io.read_mesh(tmp_path / f"mesh{suffix}")
    assert np.array_equal(read_vertices.astype(np.float32), vertices)
    assert np.array_equal(read_faces, faces)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".xyz"])
def test_written_points_are_read_back_even_none(tmp_path, suffix):
    for n in (0, 20):
        points = np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32)
        io.write_points(tmp_path / f"points{suffix}", points)
        assert np.array_equal(io.read_points(tmp_path / f"points{suffix}").astype(np.float32), points)


def _binary_ply(order: str, polygons, extra_in_list: bool) -> bytes:
    name = "little" if order == "<" else "big"
    header = f"ply\nformat binary_{name}_endian 1.0\ncomment made by hand\nelement camera 1\nproperty double focal\n"
    header += "element vertex 4\nproperty uchar red\nproperty double x\nproperty float y\nproperty short z\n"
    header += f"element face {len(polygons)}\nproperty list uchar uint vertex_index\n"
    header += "property list int short flags\n" if extra_in_list else ""
    body = struct.pack(order + "d", 285.0)
    body += b"".join(struct.pack(order + "Bdfh", 7, x, y, round(2 * z)) for x, y, z in VERTICES)
    for number, polygon in enumerate(polygons):
        body += struct.pack(f"{order}B{len(polygon)}I", len(polygon), *polygon)
        if extra_in_list:
            body += struct.pack(f"{order}i{number}h", number, *range(number))
    return header.encode() + b"end_header\n" + body


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("polygons", "extra", "faces"),
    [
        (FACES.tolist(), False, FACES.tolist()),
        ([[0, 1, 2, 3]], False, FACES.tolist()),
        ([[0, 1, 2, 3], [1, 2, 3]], True, [[1, 2, 3], *FACES.tolist()]),
    ],
)
def test_binary_ply_of_both_byte_orders_skips_what_it_does_not_need(tmp_path, order, polygons, extra, faces):
    (tmp_path / "mesh.ply").write_bytes(_binary_ply(order, polygons, extra))
    vertices, read = io.read_mesh(tmp_path / "mesh.ply")
    assert np.array_equal(vertices, VERTICES * [1, 1, 2])
    assert np.array_equal(read, faces)


def test_ascii_ply_with_quads_and_further_properties(tmp_path):
    (tmp_path / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "property float confidence\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 1\n1 0 0 1\n1 1 0 1\n0 1 .5 1\n4 0 1 2 3\n"
    )
    vertices, faces = io.read_mesh(tmp_path / "mesh.ply")
    assert np.array_equal(vertices, VERTICES)
    assert np.array_equal(faces, FACES)


def test_obj_with_slashes_negative_indices_and_polygons(tmp_path):
    (tmp_path / "mesh.obj").write_text(
        "# comment\nmtllib none.mtl\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0 # corner\nv 0 1 .5\nvt 0 0\nvn 0 0 1\nl 1 2\n"
        "f 1/1/1 2//1 -2/1 \\\n-1\n"
    )
    vertices, faces = io.read_mesh(tmp_path / "mesh.obj")
    assert np.array_equal(vertices, VERTICES)
    assert np.array_equal(faces, FACES)


def test_a_backslash_continues_no_comment_and_no_path(tmp_path):
    """Line numbers stay those of the file."""
    (tmp_path / "mesh.obj").write_text(
        "# made in C:\\garments\\\nv 0 0 0 1 0 0\nv 1 0 \\\n 0\nv 1 1 0\nv 0 1 .5\n"
        "mtllib C:\\x\\\nf 1 2 3 4\nusemtl \\\nf 1 2 x\n"
    )
    with pytest.raises(InvalidFile, match="line 10"):
        io.read_mesh(tmp_path / "mesh.obj")
    (tmp_path / "mesh.obj").write_text((tmp_path / "mesh.obj").read_text().replace("f 1 2 x\n", ""))
    vertices, faces = io.read_mesh(tmp_path / "mesh.obj")
    assert np.array_equal(vertices, VERTICES)
    assert np.array_equal(faces, FACES)


def test_a_concave_polygon_is_cut_into_triangles_that_look_its_way(tmp_path):
    """A dart, a quadrangle whose first diagonal lies outside, and a star, each tilted: triangles of one side, and their area."""
    angle = 2 * np.pi * np.arange(20) / 20
    star = np.where(np.arange(20) % 2, 0.3, 1.0)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    dart = np.array([[0, 0], [2, 0], [2, 2], [1, 0.2], [0, 2]])
    for flat in (dart, np.array([[1, 0.3], [2, 0], [1, 2], [0, 0]]), star, star[::-1]):
        x, y = flat.T
        area = 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
        place = np.stack([x, y, 0.5 * x + 0.1 * y], axis=1)
        lines = [f"v {a} {b} {c}" for a, b, c in place] + ["f " + " ".join(str(k + 1) for k in range(len(flat)))]
        (tmp_path / "mesh.obj").write_text("\n".join(lines))
        vertices, faces = io.read_mesh(tmp_path / "mesh.obj")
        a, b, c = vertices[faces][:, :, :2].transpose(1, 0, 2)
        doubled = np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2]
        assert (np.sign(doubled) == np.sign(area)).all()
        assert 0.5 * doubled.sum() == pytest.approx(area)
        assert len(faces) == len(flat) - 2


def test_text_points_with_commas_counts_colours_and_comments(tmp_path):
    (tmp_path / "cloud.txt").write_text("2\n# x y z r g b\n1, 2, 3, 255\n\n4;5;6;0  # end\n")
    assert np.array_equal(io.read_points(tmp_path / "cloud.txt"), [[1, 2, 3], [4, 5, 6]])


FACE = "element face 1\nproperty list char int vertex_indices\nend_header\n"
PLY = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("name", "content", "names"),
    [
        ("a.ply", b"", "header"),
        ("a.ply", b"ply\nformat ascii 2\nelement\nend_header\n", "header line 3"),
        ("a.ply", b"ply\nelement vertex 0\nproperty float x\nend_header\n", "format line"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nend_header\n1\n", "properties x, y and z"),
        ("a.ply", (PLY + "end_header\n").encode(), "1 records"),
        ("a.ply", (PLY.replace("vertex 1", "vertex \xb2") + "end_header\n1 2 3\n").encode("latin-1"), "header line 3"),
        ("a.ply", (PLY.replace("vertex 1", "vertex " + "9" * 5000) + "end_header\n1 2 3\n").encode(), "header line 3"),
        ("a.ply", (PLY.replace("vertex 1", "vertex 99999999999") + "end_header\n1 2 3\n").encode(), "99999999999 records, got 1"),
        ("a.ply", (PLY + "end_header\n1 2\n").encode(), "vertex 0"),
        ("a.ply", (PLY + "end_header\n1 2 nan\n").encode(), "finite"),
        ("a.ply", (PLY + FACE + "1 2 3\n3 0 0\n").encode(), "face 0"),
        ("a.ply", (PLY + FACE + "1 2 3\n3 0 0 1\n").encode(), "indices in"),
        ("a.ply", (PLY + "end_header\n1 2 3\n").encode(), "at least one face"),
        ("a.ply", _binary_ply("<", FACES.tolist(), False)[:-3], "face"),
        ("a.ply", _binary_ply(">", [[0, 1, 2]], False)[:-30], "vertex"),
        ("a.obj", b"v 1 2\n", "line 1"),
        ("a.obj", b"v 1 2 3\nf 1 1 x\n", "line 2"),
        ("a.obj", b"v 1 2 3\nf 0 1 1\n", "line 2"),
        ("a.obj", b"v 1 2 3\nf 1 -2 1\n", "indices in"),
        ("a.xyz", b"1 2 3\n1 2\n", "mesh format"),
    ],
)  # fmt: skip
def test_malformed_meshes_give_one_sentence(tmp_path, name, content, names):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidFile, match=names) as caught:
        io.read_mesh(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".xyz", ".npz"])
def test_damaged_bytes_never_escape_as_another_error(tmp_path, suffix):
    path = tmp_path / f"good{suffix}"
    if suffix == ".npz":
        np.savez_compressed(path, garment_V=VERTICES[None], garment_F=FACES, fps=30.0)
    elif suffix == ".xyz":
        io.write_points(path, VERTICES)
    else:
        io.write_mesh(path, VERTICES, FACES)
    good, rng = path.read_bytes(), np.random.default_rng(0)
    read = {".npz": io.load_sequence, ".xyz": io.read_points}.get(suffix, io.read_mesh)
    for _ in range(300):
        bad = bytearray(good[: rng.integers(1, len(good) + 1)])
        for at in rng.integers(0, len(bad), 3):
            bad[at] = rng.integers(256)
        path.write_bytes(bad)
        with contextlib.suppress(DdakfError):
            read(path)


def test_files_that_are_not_there_or_not_written(tmp_path):
    with pytest.raises(InvalidFile, match="nothing there"):
        io.read_points(tmp_path / "none.ply")
    with pytest.raises(InvalidFile, match="a folder"):
        io.read_mesh(tmp_path)
    with pytest.raises(InvalidFile, match=r"\.stl"):
        io.write_mesh(tmp_path / "mesh.stl", VERTICES, FACES)


@pytest.mark.parametrize(
    "error", [ModuleNotFoundError("No module named 'open3d'"), OSError("libusb-1.0.so.0: cannot open")]
)
def test_without_open3d_other_formats_say_what_to_install(tmp_path, monkeypatch, error):
    def refuse(name, *rest, original=builtins.__import__):
        if name == "open3d":
            raise error
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    (tmp_path / "cloud.pcd").write_text("")
    with pytest.raises(MissingDependency, match="ddakf\\[evaluation\\]") as caught:
        io.read_points(tmp_path / "cloud.pcd")
    assert ("libusb-1.0-0" in str(caught.value)) == isinstance(error, OSError)


def test_pcd_through_open3d(tmp_path):
    try:
        open3d_bridge.import_open3d()
    except MissingDependency as missing:
        pytest.skip(str(missing))
    (tmp_path / "cloud.pcd").write_text(
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n"
        "1 2 3\nnan nan nan\n"
    )
    assert np.array_equal(io.read_points(tmp_path / "cloud.pcd"), [[1, 2, 3]])
    whole = (tmp_path / "cloud.pcd").read_text()
    (tmp_path / "cloud.pcd").write_text(whole.rstrip().rpartition("\n")[0] + "\n")
    with pytest.raises(InvalidFile, match=r"cloud\.pcd: POINTS: expected a line for each of \d points"):
        io.read_points(tmp_path / "cloud.pcd")  # its writer was interrupted
    (tmp_path / "cloud.pcd").write_text("no cloud")
    with pytest.raises(InvalidFile, match="Open3D"):
        io.read_points(tmp_path / "cloud.pcd")


@pytest.mark.parametrize("count", ["WIDTH 2\nHEIGHT 1\nPOINTS 99999999999\n", "WIDTH 900000\nHEIGHT 900000\nPOINTS 2\n"])
def test_a_pcd_that_announces_more_points_than_it_can_hold_is_refused_before_room_is_made(tmp_path, monkeypatch, count):
    monkeypatch.setattr(open3d_bridge, "import_open3d", lambda: None)
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    (tmp_path / "cloud.pcd").write_bytes(f"{header}{count}DATA binary\n".encode() + bytes(24))
    with pytest.raises(InvalidFile, match=r"cloud\.pcd: POINTS: expected a number of points that 1\d\d bytes can hold"):
        io.read_points(tmp_path / "cloud.pcd")


def test_sample_is_complete_and_small():
    sequence = sample()
    assert sequence.garment_vertices.shape == (150, 2658, 3)
    assert sequence.body_vertices.shape == (150, 5502, 3)
    assert sequence.garment_rest.shape == (2658, 3)
    assert sequence.timestamp(15) == 0.5
    assert SAMPLE.stat().st_size < 5e6


def test_packing_keeps_coordinates_within_half_a_quantum(tmp_path):
    rng = np.random.default_rng(0)
    motion = np.cumsum(rng.normal(size=(6, 4, 3)) * 0.01, axis=0)
    np.savez(
        tmp_path / "a.npz",
        garment_V=motion,
        garment_F=FACES,
        fps=25,
        body_V=motion + 1,
        body_F=FACES,
        garment_rest=motion[0],
    )
    error = pack(tmp_path / "a.npz", tmp_path / "b.npz", quantum=1e-3)
    packed = io.load_sequence(tmp_path / "b.npz")
    assert 0 < error <= 0.5e-3 + 1e-7
    assert np.abs(packed.body_vertices - motion - 1).max() <= error + 1e-7
    assert packed.fps == 25


def test_packing_refuses_in_a_sentence(tmp_path, capsys):
    np.savez(tmp_path / "fast.npz", garment_V=np.array([VERTICES, VERTICES + 50]), garment_F=FACES, fps=30.0)
    for words, said in (
        (["none.npz", "b.npz"], "nothing there"),
        (["fast.npz", "b.npy"], "ends in .npz"),
        (["fast.npz", "b.npz"], "32768 quanta"),
    ):
        with pytest.raises(SystemExit):
            pack_main([str(tmp_path / word) for word in words])
        assert said in capsys.readouterr().err.splitlines()[-1]
    with pytest.raises(SystemExit):
        pack_body_main([str(tmp_path), str(tmp_path / "body.npz")])
    assert "MakeHuman's base.obj, got none" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["fast.npz"]


GOOD = dict(garment_V=VERTICES[None], garment_F=FACES, fps=30.0)
PACKED = {"garment_V": None, "garment_V_second_difference": np.zeros((1, 3, 4), np.int16), "quantum": 1e-3}

CODED = {
    "garment_V": None, "garment_V_first": np.zeros((4, 3), np.int32), "garment_V_residual": np.zeros((2, 3, 4), np.int8),
    "quantum": 1e-3,
}  # fmt: skip
SHAPED = {"body_rotations": np.zeros((1, 20, 3)), "body_shift": np.zeros((1, 3))}


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"garment_V": None}, "garment_V"),
        ({"garment_F": None}, "garment_F"),
        ({"fps": None}, "fps"),
        ({"fps": np.array(-1.0)}, "fps"),
        ({"fps": np.array("30")}, "fps"),
        ({"garment_V": VERTICES}, "garment_V: expected shape"),
        ({"garment_V": VERTICES[None] * np.nan}, "finite"),
        ({"garment_V": VERTICES[None] * 1e300 * 10}, "finite"),
        ({"garment_V": np.array([[["a"] * 3]])}, "numbers"),
        ({"garment_V": np.array([{}])}, "plain arrays"),
        ({"garment_F": FACES + 2}, "indices in"),
        ({"garment_F": FACES * 1.0}, "integers"),
        ({"garment_rest": VERTICES[:2]}, "garment_rest"),
        ({"body_V": VERTICES[None]}, "body_F"),
        ({"body_V": np.stack([VERTICES] * 2), "body_F": FACES}, "1 frames"),
        ({"garment_V": None, "garment_V_second_difference": np.zeros((1, 3, 4), np.int16)}, "quantum"),
        ({"fps": np.array(1e-320)}, "fps"),
        (PACKED | {"quantum": np.inf}, "quantum: expected one float"),
        (PACKED | {"quantum": np.nan}, "quantum: expected one float"),
        (PACKED | {"garment_V_second_difference": np.full((1, 3, 4), 2**62)}, "int16 of shape"),
        (PACKED | {"garment_V_second_difference": np.zeros((1, 2, 4), np.int16)}, "garment_V: expected shape"),
        (CODED | {"quantum": None}, "quantum: expected to be"),
        (CODED | {"garment_V_first": None}, "garment_V_first"),
        (CODED | {"garment_V_first": np.zeros((4, 2), np.int32)}, r"garment_V_first: expected int32 of shape \(V, 3\)"),
        (CODED | {"garment_V_residual": np.zeros((2, 3, 5), np.int8)}, "garment_V_residual: expected int8 or int16"),
        (CODED | {"garment_V_residual": np.zeros((2, 3, 4))}, "garment_V_residual: expected int8 or int16"),
        (CODED | {"garment_F": FACES + 2}, "indices in"),
        (SHAPED | {"body_shape": np.ones(7)}, r"body_shape: expected factors of shape \(8,\)"),
        (SHAPED | {"body_shape": np.full(8, 9.0)}, "body_shape: expected a factor"),
        (SHAPED | {"body_shape": np.full(8, np.nan)}, "body_shape: expected finite"),
        ({"body_rotations": np.zeros((1, 20, 3))}, "body_shift"),
        ({"body_rotations": np.zeros((1, 7, 3)), "body_shift": np.zeros((1, 3))}, "body_rotations: expected with"),
        ({"body_rotations": np.zeros((2, 20, 3)), "body_shift": np.zeros((2, 3))}, "body_rotations"),
        ({"body_rotations": np.zeros((1, 20, 3)), "body_shift": np.full((1, 3), np.nan)}, "body_shift: expected finite"),
        ({"motion": np.array(["walk"])}, "motion: expected one word"),
    ],
)
def test_broken_sequences_name_the_key(tmp_path, change, names):
    arrays = {key: value for key, value in {**GOOD, **change}.items() if value is not None}
    np.savez(tmp_path / "sequence.npz", **arrays)
    with pytest.raises(InvalidFile, match=names) as caught:
        io.load_sequence(tmp_path / "sequence.npz")
    assert "\n" not in str(caught.value)


def test_an_error_that_quotes_what_it_read_stays_a_sentence(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", **GOOD)
    data = (tmp_path / "a.npz").read_bytes()
    place = data.index(b"garment_V.npy")
    (tmp_path / "a.npz").write_bytes(data[: place - 4] + b"\xff\x01" + data[place - 2 :])  # the length of that name
    with pytest.raises(InvalidFile, match="BadZipFile") as caught:
        io.load_sequence(tmp_path / "a.npz")
    assert len(str(caught.value)) < 250 + len(str(tmp_path))


def test_a_single_array_is_no_sequence(tmp_path):
    np.save(tmp_path / "array.npy", VERTICES)
    with pytest.raises(InvalidFile, match="archive"):
        io.load_sequence(tmp_path / "array.npy")


PLY = "ply\nformat ascii 1.0\n{}\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
PCD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nPOINTS 1\n{}\nDATA ascii\n0 0 0\nVIEWPOINT 9 9 9\n"
SAID = {
    ("a.ply", PLY.format("comment sensor_origin 1 -2.5 3e-1")): [1, -2.5, 0.3],
    ("a.ply", PLY.format("comment made by hand")): None,
    ("a.pcd", PCD.format("VIEWPOINT 0.5 1 2 1 0 0 0")): [0.5, 1, 2],
    ("a.pcd", PCD.format("VIEWPOINT 0 0 0 1 0 0 0")): None,  # what writers put that do not know it
    ("a.pcd", PCD.format("VIEWPOINT 0 0 0 0 1 0 0")): [0, 0, 0],
    ("a.pcd", PCD.format("")): None,
    ("a.xyz", "0 0 0\n"): None,
}


@pytest.mark.parametrize(("file", "origin"), SAID.items())
def test_the_origin_of_a_cloud_is_read_from_its_header(tmp_path, file, origin):
    name, text = file
    (tmp_path / name).write_text(text)
    found = io.read_sensor_origin(tmp_path / name)
    assert found is None if origin is None else np.array_equal(found, origin)


def test_the_origin_that_is_written_with_points_is_read_back(tmp_path):
    points = np.float32([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    io.write_points(tmp_path / "a.ply", points, (0.5, 1.25, -2.0))
    assert np.array_equal(io.read_points(tmp_path / "a.ply"), points)
    assert io.read_sensor_origin(tmp_path / "a.ply").tolist() == [0.5, 1.25, -2.0]


@pytest.mark.parametrize("line", ["comment sensor_origin 1 2", "comment sensor_origin 1 2 nan", "comment sensor_origin here"])
def test_an_origin_that_is_none_is_refused(tmp_path, line):
    (tmp_path / "a.ply").write_text(PLY.format(line))
    with pytest.raises(InvalidFile, match=r"a.ply: sensor origin: expected three finite numbers, got comment sensor_origin"):
        io.read_sensor_origin(tmp_path / "a.ply")


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
def test_colours_of_points_are_read(tmp_path, layout):
    names = ["x", "y", "z", "red", "green", "blue"]
    header = ["ply", f"format {layout} 1.0", "element vertex 2"]
    header += [f"property {'uchar' if len(name) > 1 else 'float'} {name}" for name in names] + ["end_header", ""]
    rows = [(0.0, 1.0, 2.0, 255, 0, 7), (3.0, 4.0, 5.0, 1, 2, 3)]
    if layout == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    else:
        body = np.array(rows, [(name, "u1" if len(name) > 1 else "<f4") for name in names]).tobytes()
    (tmp_path / "a.ply").write_bytes("\n".join(header).encode() + body)
    points, colors = io.read_coloured_points(tmp_path / "a.ply")
    assert np.array_equal(points, [[0, 1, 2], [3, 4, 5]])
    assert colors.dtype == np.uint8
    assert np.array_equal(colors, [[255, 0, 7], [1, 2, 3]])


def test_a_colour_that_is_no_byte_is_refused(tmp_path):
    header = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {axis}" for axis in "xyz")]
    header += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header", "0 0 0 256 0 0", ""]
    (tmp_path / "a.ply").write_text("\n".join(header))
    with pytest.raises(InvalidFile, match="red, green and blue of 0 to 255, got 0 to 256"):
        io.read_coloured_points(tmp_path / "a.ply")


def test_files_without_colours_have_none(tmp_path):
    io.write_points(tmp_path / "a.ply", np.zeros((2, 3), np.float32))
    (tmp_path / "a.xyz").write_text("0 0 0\n")
    assert io.read_coloured_points(tmp_path / "a.ply")[1] is None
    assert io.read_coloured_points(tmp_path / "a.xyz")[1] is None


def test_a_ply_that_declares_a_property_twice_is_refused(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nproperty float x\n"
    (tmp_path / "a.ply").write_text(f"{header}end_header\n1 2 3 4\n")
    with pytest.raises(InvalidFile, match=r"a\.ply: header: expected each property of vertex once, got x twice"):
        io.read_points(tmp_path / "a.ply")

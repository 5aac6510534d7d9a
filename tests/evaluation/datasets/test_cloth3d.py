"""CLOTH3D: a small sequence in the published format gives its garments, upright, in place, and the body where SMPL is at hand."""

import struct

import numpy as np
import pytest
from scipy.io import loadmat, savemat
from scipy.spatial.transform import Rotation

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets import cloth3d, open_dataset
from ddakf.evaluation.datasets.cloth3d import load_cloth3d
from ddakf.evaluation.datasets.formats import smpl
from ddakf.evaluation.datasets.formats.point_cache import FLOATS, HEADER, SIGNATURE, read_point_cache

FRAMES, ZROT = 5, 0.7
QUADS = [[0, 1, 4, 3], [1, 2, 5, 4]]  # a sheet of two squares
REST = np.array([[x, 0.4 * y, 0.1 * x] for y in (0, 1) for x in (-0.3, 0.0, 0.3)])
TRANS = np.column_stack([np.linspace(0, 1, FRAMES), np.zeros(FRAMES), np.linspace(0.9, 1.1, FRAMES)])
POSES = 0.2 * np.random.default_rng(0).normal(size=(FRAMES, 72))


def relative(frame):
    """The sheet in a frame, relative to the root joint, z up."""
    return Rotation.from_euler("x", 90 + 5 * frame, degrees=True).apply(REST)


def write_point_cache(path, vertices: np.ndarray) -> None:
    """Writes (T, V, 3) vertices in the floats of the path's suffix."""
    header = HEADER.pack(SIGNATURE, 1, vertices.shape[1], 0.0, 1.0, vertices.shape[0])
    path.write_bytes(header + np.ascontiguousarray(vertices, FLOATS[path.suffix.lower()]).tobytes())


@pytest.fixture
def sequence(tmp_path):
    """A folder as published: a template of quads with texture coordinates, a cache written field by field, and info.mat."""
    folder = tmp_path / "00042"
    folder.mkdir()
    lines = ["v {} {} {}".format(*vertex) for vertex in REST] + [f"vt {k / 6} 0.5" for k in range(6)]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in quad) for quad in QUADS]
    (folder / "Tshirt.obj").write_text("\n".join(lines) + "\n")
    with (folder / "Tshirt.pc16").open("wb") as file:
        file.write(struct.pack("<12siiffi", b"POINTCACHE2\0", 1, len(REST), 0, 1, FRAMES))
        for frame in range(FRAMES):
            file.write(relative(frame).astype("<f2").tobytes())
    outfit = {"Tshirt": {"fabric": "cotton", "texture": {"type": "color", "data": np.ones(3)}}}
    info = {"poses": POSES.T, "shape": np.linspace(-1, 1, 10), "gender": 1, "trans": TRANS.T, "zrot": ZROT, "outfit": outfit}
    savemat(folder / "info.mat", info | {"tightness": np.zeros(2), "camLoc": np.array([0.0, -7.0, 1.0])})
    return folder


def upright(points):
    """World points of CLOTH3D, z up, with y up."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def test_a_garment_is_where_and_how_it_was(sequence):
    read = load_cloth3d(sequence)
    assert (read.name, len(read), read.fps, read.garment) == ("00042_Tshirt", FRAMES, 30.0, "Tshirt")
    turn = Rotation.from_euler("z", ZROT)
    for frame in range(FRAMES):
        expected = upright(turn.apply(relative(frame) + TRANS[frame]))
        assert read.garment_vertices[frame] == pytest.approx(expected, abs=1e-3)  # 16-bit floats
    assert not read.has_body
    assert sorted(map(sorted, read.garment_faces.tolist())) == [[0, 1, 4], [0, 3, 4], [1, 2, 5], [1, 4, 5]]


def test_the_template_is_the_rest_shape_laid_onto_the_first_frame(sequence):
    read = load_cloth3d(sequence)
    assert read.garment_rest == pytest.approx(read.garment_vertices[0], abs=2e-3)
    distance = np.linalg.norm(read.garment_rest[:, None] - read.garment_rest, axis=2)
    assert distance == pytest.approx(np.linalg.norm(REST[:, None] - REST, axis=2), abs=1e-6)


def test_one_of_several_garments_has_to_be_named(sequence):
    for suffix in (".obj", ".pc16"):
        (sequence / f"Skirt{suffix}").write_bytes((sequence / f"Tshirt{suffix}").read_bytes())
    (sequence / "Top.pc16").write_bytes(b"")  # without a template it is no garment
    assert cloth3d.garments(sequence) == ("Skirt", "Tshirt")
    assert load_cloth3d(sequence, "Skirt").name == "00042_Skirt"
    with pytest.raises(InvalidArgument, match="one of Skirt, Tshirt, got None"):
        load_cloth3d(sequence)
    with pytest.raises(InvalidArgument, match="got Dress"):
        load_cloth3d(sequence, "Dress")


def _info(folder, **changes):
    info = {name: loadmat(folder / "info.mat")[name] for name in cloth3d.NUMBERS} | changes
    savemat(folder / "info.mat", {name: value for name, value in info.items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"trans": None}, "trans"),
        ({"trans": np.zeros((3, 2))}, r"of 5 frames as in Tshirt\.pc16, got 5 and 2"),
        ({"poses": np.zeros((72, 3))}, r"of 5 frames as in Tshirt\.pc16, got 3 and 5"),
        ({"trans": np.full((3, 5), 1e300)}, "numbers up to 1e"),
        ({"poses": np.zeros((70, 5))}, "poses"),
        ({"zrot": np.nan}, "zrot"),
        ({"gender": 7}, "gender"),
        ({"shape": "ten"}, "shape"),
    ],
)
def test_what_is_wrong_with_the_information_is_named(sequence, changes, said):
    _info(sequence, **changes)
    with pytest.raises(InvalidFile, match=said):
        load_cloth3d(sequence)


def test_a_folder_that_is_no_sequence_is_refused(sequence, tmp_path):
    with pytest.raises(InvalidFile, match=r"info\.mat"):
        load_cloth3d(tmp_path)
    write_point_cache(sequence / "Tshirt.pc16", np.zeros((FRAMES, 5, 3)))
    with pytest.raises(InvalidFile, match=r"6 vertices as in Tshirt\.obj, got 5"):
        load_cloth3d(sequence)
    (sequence / "Tshirt.pc16").unlink()
    with pytest.raises(InvalidFile, match="template"):
        load_cloth3d(sequence)
    (sequence / "info.mat").write_text("no MATLAB file " * 20)
    with pytest.raises(InvalidFile, match="MATLAB"):
        load_cloth3d(sequence)


# Point caches ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suffix", "error"), [(".pc2", 0), (".pc16", 5e-4)])
def test_what_is_written_is_read_again(tmp_path, suffix, error):
    vertices = np.random.default_rng(0).uniform(-1, 1, (4, 7, 3)).astype(np.float32)
    write_point_cache(tmp_path / f"a{suffix}", vertices)
    assert (tmp_path / f"a{suffix}").stat().st_size == 32 + vertices.size * (4 if suffix == ".pc2" else 2)
    assert np.abs(read_point_cache(tmp_path / f"a{suffix}") - vertices).max() <= error


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"POINTCACHE2\0" + bytes(19),
        struct.pack("<12siiffi", b"POINTCACHE3\0", 1, 1, 0, 1, 1) + bytes(6),
        struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 2, 0, 1, 1) + bytes(6),
        struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 2**31 - 1, 0, 1, 2**31 - 1) + bytes(6),
        struct.pack("<12siiffi", b"POINTCACHE2\0", 1, -1, 0, 1, -1) + bytes(6),
        struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 0, 0, 1, 0),
        struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 1, 0, 1, 1) + np.full(3, np.nan, "<f2").tobytes(),
    ],
)
def test_a_cache_that_is_not_what_its_header_says_is_refused(tmp_path, data):
    (tmp_path / "a.pc16").write_bytes(data)
    with pytest.raises(InvalidFile, match=r"a\.pc16"):
        read_point_cache(tmp_path / "a.pc16")
    with pytest.raises(InvalidFile, match="point cache"):
        read_point_cache(tmp_path / "a.txt")


# SMPL -----------------------------------------------------------------------------------------------------------------


def model_arrays(joints=24, per_joint=3):
    """A model of the published form whose bones are a chain along y with a few vertices around each."""
    rng = np.random.default_rng(1)
    count = joints * per_joint
    bone = np.repeat(np.arange(joints), per_joint)
    template = np.column_stack([0.1 * rng.normal(size=count), 0.1 * bone + 0.3, 0.1 * rng.normal(size=count)])
    regressor = np.zeros((joints, count))
    regressor[bone, np.arange(count)] = 1 / per_joint
    tree = np.stack([np.arange(joints) - 1, np.arange(joints)]).astype(np.uint32)  # the root's parent is 2^32 - 1
    faces = np.column_stack([np.arange(count - 2), np.arange(1, count - 1), np.arange(2, count)])
    return {
        "v_template": template,
        "shapedirs": 0.01 * rng.normal(size=(count, 3, 10)),
        "posedirs": 0.001 * rng.normal(size=(count, 3, 9 * (joints - 1))),
        "J_regressor": regressor,
        "weights": np.eye(joints)[bone],
        "kintree_table": tree,
        "f": faces.astype(np.uint32),
    }


def posed_one_by_one(arrays, pose, shape):
    """SMPL's equations, a vertex and a joint at a time, with 4 x 4 matrices."""
    shaped = arrays["v_template"] + arrays["shapedirs"] @ shape
    joints = arrays["J_regressor"] @ shaped
    rotation = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix()
    vertices = shaped + arrays["posedirs"] @ (rotation[1:] - np.eye(3)).ravel()
    world = []
    for j, local in enumerate(rotation):
        matrix = np.eye(4)
        matrix[:3, :3] = local
        parent = int(arrays["kintree_table"][0, j]) if j else None
        matrix[:3, 3] = joints[j] - (joints[parent] if j else 0)
        world.append(matrix if parent is None else world[parent] @ matrix)
    result = []
    for v, weight in zip(vertices, arrays["weights"], strict=True):
        blend = sum(w * matrix @ np.append(v - joint, 1) for w, matrix, joint in zip(weight, world, joints, strict=True))
        result.append(blend[:3] - joints[0])
    return np.array(result)


def test_the_body_follows_smpls_equations(tmp_path):
    arrays = model_arrays()
    arrays["weights"] = np.random.default_rng(2).dirichlet(np.ones(24), len(arrays["weights"]))
    np.savez(tmp_path / "model.npz", **arrays)
    model, shape = smpl.load_smpl(tmp_path / "model.npz"), np.linspace(-1, 1, 10)
    bodies = model(POSES, shape)
    for frame in range(FRAMES):
        assert bodies[frame] == pytest.approx(posed_one_by_one(arrays, POSES[frame], shape), abs=1e-5)


@pytest.mark.parametrize("given", ["file", "folder"])
def test_the_body_stands_where_the_garment_does(sequence, tmp_path, given):
    arrays = model_arrays()
    np.savez(tmp_path / "model_m.npz", **arrays)
    read = load_cloth3d(sequence, smpl=tmp_path / "model_m.npz" if given == "file" else tmp_path)
    expected = posed_one_by_one(arrays, POSES[3], np.linspace(-1, 1, 10))
    turn = Rotation.from_euler("z", ZROT)
    assert read.body_vertices[3] == pytest.approx(upright(turn.apply(expected + TRANS[3])), abs=1e-5)
    assert np.array_equal(read.body_faces, arrays["f"])


def test_the_environment_says_where_smpl_is(sequence, tmp_path, monkeypatch):
    np.savez(tmp_path / "model_m.npz", **model_arrays())
    monkeypatch.delenv("DDAKF_SMPL", raising=False)
    assert not open_dataset(f"{sequence}#Tshirt").has_body
    monkeypatch.setenv("DDAKF_SMPL", str(tmp_path))
    assert np.array_equal(open_dataset(sequence).body_vertices, load_cloth3d(sequence, smpl=tmp_path).body_vertices)


def test_a_pickle_is_never_read_and_arrays_have_to_fit(sequence, tmp_path):
    (tmp_path / "model_m.pkl").write_bytes(b"cos\nsystem\n(S'exit 1'\ntR.")
    with pytest.raises(InvalidFile, match="no pickle is read"):
        load_cloth3d(sequence, smpl=tmp_path / "model_m.pkl")
    arrays = model_arrays()
    loop = arrays["kintree_table"].copy()
    loop[0, 3] = 5
    for name, value in (
        ("weights", arrays["weights"][:, 1:]),
        ("posedirs", arrays["posedirs"][:, :, 1:]),
        ("kintree_table", loop),
        ("f", arrays["f"] + 1),
        ("f", arrays["f"] + 0.5),
        ("f", arrays["f"][:0]),
        ("v_template", np.zeros(())),
        ("kintree_table", np.zeros((3, 24))),
        ("v_template", arrays["v_template"] * np.nan),
        ("shapedirs", np.array([{"not": "plain"}])),
    ):
        np.savez(tmp_path / "model_m.npz", **arrays | {name: value})
        with pytest.raises(InvalidFile, match=name):
            load_cloth3d(sequence, smpl=tmp_path)
    np.savez(tmp_path / "model_m.npz", **arrays | {"shapedirs": arrays["shapedirs"][:, :, :6]})
    with pytest.raises(InvalidFile, match=r"10 shape directions as in info\.mat, got 6"):
        load_cloth3d(sequence, smpl=tmp_path)
    with pytest.raises(InvalidFile, match="got nothing there"):
        load_cloth3d(sequence, smpl=tmp_path / "model_f.npz")
    np.savez(tmp_path / "model_m.npz", **model_arrays(joints=20))
    with pytest.raises(InvalidFile, match="24 joints"):
        load_cloth3d(sequence, smpl=tmp_path)

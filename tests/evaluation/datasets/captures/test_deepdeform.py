"""Pairs of DeepDeform: true flow in the world's axes, a template of the object, and the flow that a garment on it means."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets.captures import deepdeform
from ddakf.evaluation.datasets.captures.deepdeform import load_pair, read_scene_flow
from ddakf.evaluation.metrics import SurfaceDistance
from ddakf.evaluation.sensors.camera import Camera, Intrinsics

LENS = Intrinsics(width=80, height=60, fx=80.0, fy=80.0, cx=39.5, cy=29.5)
CAMERA = Camera.at_origin(LENS)
CLOTH = np.array([[-0.3, -0.25, -1.2], [0.2, -0.25, -1.25], [0.2, 0.2, -1.25], [-0.3, 0.2, -1.2]])
PERSON = np.array([[0.05, -1, -1.45], [0.4, -1, -1.45], [0.4, 1, -1.45], [0.05, 1, -1.45]])  # who holds it, from behind
WALL = np.array([[-3, -3, -2.5], [3, -3, -2.5], [3, 3, -2.5], [-3, 3, -2.5]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
MOVE = np.array([0.12, -0.06, 0.05])  # world axes
UNIT = np.array([1.0, -1.0, -1.0])  # from world axes to those of the camera


def _write_flow(path, flow):
    path.write_bytes(np.array([flow.shape[2], flow.shape[1], 3], "<i4").tobytes() + flow.astype("<f4").tobytes())


@pytest.fixture
def folder(tmp_path):
    """A sheet in front of a wall that moves by MOVE from frame 0 to frame 30, in the published layout."""
    folder = tmp_path / "seq007"
    for name in ("depth", "mask", "scene_flow"):
        (folder / name).mkdir(parents=True)
    for frame, moved in ((0, CLOTH), (30, CLOTH + MOVE)):
        depth, face = CAMERA.render([(moved, FACES), (PERSON, FACES), (WALL, FACES)])
        Image.fromarray(np.rint(1e3 * depth).astype(np.uint16)).save(folder / f"depth/{frame:06d}.png")
        if frame == 0:
            mask = face < 2
    Image.fromarray((65535 * mask).astype(np.uint16)).save(folder / "mask/000000_shirt.png")
    flow = np.where(mask, (MOVE * UNIT)[:, None, None], -np.inf)
    flow[:, :, ::2] = -np.inf  # every other column has no label
    _write_flow(folder / "scene_flow/shirt_000000_000030.sflow", flow)
    np.savetxt(folder / "intrinsics.txt", [[LENS.fx, 0, LENS.cx, 0], [0, LENS.fy, LENS.cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return folder


@pytest.fixture
def pair(folder):
    return load_pair(folder)


def test_the_flow_leads_from_the_source_to_the_target(pair):
    assert pair.name == "seq007_shirt_000000_000030"
    assert pair.seconds == 1.0
    assert len(pair.points) > 300
    assert pair.flow == pytest.approx(np.broadcast_to(MOVE, pair.flow.shape), abs=1e-6)
    normal = np.cross(CLOTH[1] - CLOTH[0], CLOTH[3] - CLOTH[0])
    normal /= np.linalg.norm(normal)
    assert np.abs((pair.points - CLOTH[0]) @ normal).max() < 0.001
    assert np.abs((pair.points + pair.flow - CLOTH[0] - MOVE) @ normal).max() < 0.001
    assert np.array_equal(pair.target.sensor_origin, np.zeros(3))


def test_the_target_is_cut_out_around_the_object(pair):
    assert pair.target.points[:, 2].min() > -1.3  # neither the wall nor the person
    on_the_cloth = np.abs(pair.target.points[:, 2] + 1.2 - MOVE[2]) < 0.1
    assert on_the_cloth.all()
    assert len(pair.target.points) > 600


def test_the_template_is_the_object_alone(pair):
    low, high = pair.garment.vertices.min(axis=0), pair.garment.vertices.max(axis=0)
    assert low == pytest.approx(CLOTH.min(axis=0), abs=0.03)
    assert high == pytest.approx(CLOTH.max(axis=0), abs=0.03)


def test_a_garment_gives_its_points_the_flow_of_the_places_under_them(pair):
    rest = pair.garment.vertices
    assert np.array_equal(pair.flow_of(rest), np.zeros_like(pair.flow))
    assert pair.flow_of(rest + MOVE) == pytest.approx(pair.flow, abs=1e-6)
    linear = np.array([[0.1, 0.0, 0.2], [0.0, -0.1, 0.0], [0.3, 0.0, 0.0]])
    inside = SurfaceDistance(pair.garment)(pair.points, rest) < 0.002
    assert inside.mean() > 0.8
    assert pair.flow_of(rest + rest @ linear)[inside] == pytest.approx(pair.points[inside] @ linear, abs=2e-3)


def test_a_pair_is_named_where_there_are_several(folder, pair):
    (folder / "scene_flow/sleeve_000000_000030.sflow").write_bytes(b"")
    assert deepdeform.pairs(folder) == ("shirt_000000_000030", "sleeve_000000_000030")
    with pytest.raises(InvalidArgument, match="one of shirt_000000_000030, sleeve_000000_000030"):
        load_pair(folder)
    assert np.array_equal(load_pair(folder, "shirt_000000_000030").flow, pair.flow)
    assert np.array_equal(load_pair(folder / "scene_flow/shirt_000000_000030.sflow").flow, pair.flow)
    with pytest.raises(InvalidFile, match="mask"):
        load_pair(folder, "sleeve_000000_000030")
    with pytest.raises(InvalidArgument, match="none in scene_flow"):
        load_pair(folder / "depth")


def test_what_does_not_fit_together_is_refused(folder):
    flow = folder / "scene_flow/shirt_000000_000030.sflow"
    _write_flow(flow, np.full((3, 60, 80), np.nan))
    with pytest.raises(InvalidFile, match="a label"):
        load_pair(folder)
    _write_flow(flow, np.zeros((3, 40, 80)))
    with pytest.raises(InvalidFile, match="scene flow: expected shape"):
        load_pair(folder)
    _write_flow(flow, np.zeros((3, 60, 80)))
    Image.fromarray(np.zeros((60, 80), np.uint16)).save(folder / "depth/000030.png")
    with pytest.raises(InvalidFile, match=r"depth/000030\.png: expected a surface within 0\.3 m"):
        load_pair(folder)
    (folder / "depth/000030.png").unlink()
    with pytest.raises(InvalidFile, match=r"000030\.png"):
        load_pair(folder)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\0" * 11, b"\0" * 12, np.array([2, 2, 3], "<i4").tobytes() + b"\0" * 47,
        np.array([2**31 - 1, 2**31 - 1, 3], "<i4").tobytes() + b"\0" * 48, np.array([-2, -2, 3], "<i4").tobytes() + b"\0" * 48,
        np.array([2, 2, 2], "<i4").tobytes() + b"\0" * 32,
    ],
)  # fmt: skip
def test_a_flow_that_is_not_what_its_header_says_is_refused(tmp_path, data):
    (tmp_path / "a.sflow").write_bytes(data)
    with pytest.raises(InvalidFile, match=r"a\.sflow"):
        read_scene_flow(tmp_path / "a.sflow")
    with pytest.raises(InvalidFile, match="nothing there"):
        read_scene_flow(tmp_path / "b.sflow")


@pytest.mark.recordings
def test_the_true_flow_of_a_recorded_pair_ends_on_the_target(recording):
    pair = load_pair(recording("depth/deepdeform/seq258"))
    assert np.linalg.norm(pair.flow, axis=1).mean() == pytest.approx(0.232, abs=0.001)
    away = SurfaceDistance(pair.garment)(pair.points, pair.garment.vertices)
    assert np.median(away) < 0.004
    assert np.median(cKDTree(pair.target.points).query(pair.points + pair.flow)[0]) < 0.004

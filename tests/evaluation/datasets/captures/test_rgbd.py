"""Folders of depth images: points where the scene is, masks, times, units, and one sentence for what is wrong."""

import json
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets.captures.rgbd import load_rgbd
from ddakf.evaluation.datasets.formats import depth_files
from ddakf.evaluation.datasets.formats.depth_files import read_grey
from ddakf.evaluation.sensors.camera import Camera, Intrinsics

LENS = Intrinsics(width=48, height=36, fx=50.0, fy=51.0, cx=23.0, cy=17.5)
WALL = np.array([[-1, -1, -1.5], [1, -1, -1.6], [1, 1, -1.6], [-1, 1, -1.5]])  # slanted, in front of a sensor at the origin
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def depth_metres(camera):
    return camera.render([(WALL, FACES)])[0]


def with_pose(matrix):
    return json.dumps({"fx": 1, "fy": 1, "cx": 1, "cy": 1, "T_world_sensor": matrix.tolist()})


@pytest.fixture
def folder(tmp_path):
    """Three frames, numbered 2, 10 and 11, of a wall that comes closer, and its intrinsics as a 4 x 4 matrix."""
    (tmp_path / "depth").mkdir()
    depth = depth_metres(Camera.at_origin(LENS))
    for number, nearer in ((2, 0.0), (10, 0.1), (11, 0.2)):
        Image.fromarray(np.rint(1e3 * (depth - nearer)).astype(np.uint16)).save(tmp_path / f"depth/{number}.png")
    matrix = np.eye(4)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = LENS.fx, LENS.fy, LENS.cx, LENS.cy
    np.savetxt(tmp_path / "intrinsics.txt", matrix)
    return tmp_path


def _off_the_wall(points):
    normal = np.cross(WALL[1] - WALL[0], WALL[3] - WALL[0])
    return np.abs((points - WALL[0]) @ normal / np.linalg.norm(normal))


def test_points_are_in_the_frame_of_the_sensor(folder):
    recording = load_rgbd(folder, fps=15)
    cloud = recording.cloud(0)
    assert (recording.name, len(recording), recording.fps) == (folder.name, 3, 15.0)
    assert recording.timestamp(2) == pytest.approx(2 / 15)
    assert len(cloud.points) == LENS.width * LENS.height
    assert np.array_equal(cloud.sensor_origin, np.zeros(3))
    assert np.median(_off_the_wall(cloud.points)) < 0.001
    nearest = [-recording.cloud(frame).points[:, 2].mean() for frame in range(3)]
    assert np.diff(nearest) == pytest.approx([-0.1, -0.1], abs=1e-3)
    assert recording.template().n_vertices > 500


def test_a_camera_with_a_pose_gives_points_of_the_world(folder):
    camera = Camera.looking_at(LENS, [0.3, 0.4, 0.1], [0.0, 0.0, -1.5])
    Image.fromarray(np.rint(1e4 * depth_metres(camera)).astype(np.uint16)).save(folder / "depth/2.png")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.axes.T, camera.eye
    said = {
        "fx": LENS.fx,
        "fy": LENS.fy,
        "cx": LENS.cx,
        "cy": LENS.cy,
        "depth_scale": 1e4,
        "fps": 20,
        "T_world_sensor": pose.tolist(),
    }
    (folder / "camera.json").write_text(json.dumps(said))
    recording = load_rgbd(folder)
    assert recording.fps == 20
    assert np.array_equal(recording.cloud(0).sensor_origin, camera.eye)
    assert np.median(_off_the_wall(recording.cloud(0).points)) < 1e-3


@pytest.mark.parametrize("order", ["F", "C"])
def test_open3d_writes_its_matrix_by_columns_and_others_by_rows(folder, order):
    matrix = [[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1]]
    before = load_rgbd(folder).cloud(1).points
    said = {"width": 48, "height": 36, "intrinsic_matrix": np.ravel(matrix, order=order).tolist()}
    (folder / "camera.json").write_text(json.dumps(said))
    assert np.array_equal(load_rgbd(folder).cloud(1).points, before)


def test_masks_leave_the_garment_only(folder):
    (folder / "mask").mkdir()
    for name in ("2_shirt", "10_shirt", "11_shirt"):
        mask = np.zeros((LENS.height, LENS.width), np.uint8)
        mask[5:15, 7:20] = 255
        Image.fromarray(mask).save(folder / f"mask/{name}.png")
    assert len(load_rgbd(folder).cloud(1).points) == 10 * 13
    (folder / "mask/10_shirt.png").unlink()
    with pytest.raises(InvalidFile, match=r"none for 10\.png"):
        load_rgbd(folder)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_points_have_the_colours_of_their_pixels(folder, suffix):
    (folder / "color").mkdir()
    column = np.arange(LENS.width)
    for number in (2, 10, 11):
        image = np.zeros((LENS.height, LENS.width, 3), np.uint8)
        image[:, :, 0], image[:, :, 2] = 5 * column, number
        Image.fromarray(image).save(folder / f"color/{number}.{suffix}", **({} if suffix == "png" else {"quality": 100}))
    recording = load_rgbd(folder)
    for frame, number in enumerate((2, 10, 11)):
        points, _, colors = recording.cloud(frame)
        seen_at = LENS.cx - LENS.fx * points[:, 0] / points[:, 2]  # a sensor that looks along -z
        assert colors.shape == points.shape
        assert colors.dtype == np.uint8
        assert np.abs(colors[:, 0] - 5.0 * seen_at).max() < 8
        assert np.abs(colors[:, 2].astype(int) - number).max() < 8


@pytest.mark.parametrize(
    ("shape", "numbers"), [((10, 10, 3), (2, 10, 11)), ((36, 48), (2, 10, 11)), ((36, 48, 3), (2,)), ((36, 48, 3), ())]
)
def test_colour_images_that_are_not_of_the_depths_are_left_aside(folder, shape, numbers):
    (folder / "color").mkdir()
    for number in numbers:
        Image.fromarray(np.zeros(shape, np.uint8)).save(folder / f"color/{number}.png")
    assert not hasattr(load_rgbd(folder).cloud(0), "colors")


def test_only_colours_are_read_as_such(tmp_path):
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "grey.png")
    with pytest.raises(InvalidFile, match="red, green and blue"):
        depth_files.read_colors(tmp_path / "grey.png")
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InvalidFile, match="a PNG or JPEG image"):
        depth_files.read_colors(tmp_path / "broken.jpg")


def test_timestamps_are_the_sensors(folder):
    (folder / "timestamps.txt").write_text("100.0\n100.5\n101.5\n")
    recording = load_rgbd(folder)
    assert [recording.timestamp(frame) for frame in range(3)] == [0.0, 0.5, 1.5]
    assert recording.fps == pytest.approx(2 / 1.5)
    for text in ("1\n2\n", "1\n1\n2\n", "1\n2\nthree\n", "1\n2\nnan\n", "0\n1e-320\n1\n", "-1e308\n0\n1e308\n", "", "\n"):
        (folder / "timestamps.txt").write_text(text)
        with pytest.raises(InvalidFile, match=r"timestamps\.txt"):
            load_rgbd(folder)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("intrinsics.txt", "1 2\n3 4\n", "matrix"),
        ("intrinsics.txt", "0 0 1\n0 5 1\n0 0 1\n", "positive"),
        ("intrinsics.txt", "a b c\n", "numbers"),
        ("intrinsics.txt", "5 0 0\n0 5 0\n2 2 1\n", "cx and cy in the last column"),  # written by columns
        ("camera.json", '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "width": 640, "height": 480}', "as the images, got 640 x 480"),
        ("camera.json", '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "depth_scale": 0.001}', "1000 for millimetres"),
        ("camera.json", "{", "JSON"),
        ("camera.json", "[]", "object"),
        ("camera.json", "{}", "fx, fy, cx, cy"),
        ("camera.json", '{"fx": 1, "fy": NaN, "cx": 1, "cy": 1}', "fx, fy, cx, cy"),
        ("camera.json", '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "depth_scale": 0}', "depth_scale"),
        ("camera.json", '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "depth_scale": "m"}', "depth_scale"),
        ("camera.json", '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "fps": "fast"}', "fps"),
        ("camera.json", '{"fx": true, "fy": 1, "cx": 1, "cy": 1}', "fx, fy, cx, cy"),
        ("camera.json", '{"fx": 1' + "0" * 400 + ', "fy": 1, "cx": 1, "cy": 1}', "fx, fy, cx, cy"),
        ("camera.json", '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "depth_scale": 1e-300}', "depth_scale"),
        ("camera.json", '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "fps": 1' + "0" * 400 + "}", "fps"),
        ("camera.json", '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "T_world_sensor": [[1]]}', "T_world_sensor"),
        ("camera.json", with_pose(np.diag([1.0, 1.0, -1.0, 1.0])), "a rotation"),  # a mirror
        ("camera.json", with_pose(np.diag([1e3, 1e3, 1e3, 1.0])), "a rotation"),  # in millimetres
        ("camera.json", with_pose(np.eye(4) + np.eye(4, k=-3)), "row 0, 0, 0, 1"),  # written by columns
        ("camera.json", with_pose(np.diag([1.0, 1.0, 1.0, np.nan])), "finite"),
        ("camera.json", "[" * 100_000, "JSON"),
        ("camera.json", " " * (1 << 21), "bytes"),
    ],
)
def test_intrinsics_without_sense_are_refused(folder, name, text, said):
    (folder / name).write_text(text)
    with pytest.raises(InvalidFile, match=said):
        load_rgbd(folder)


def test_a_folder_that_lacks_something_is_refused(folder, tmp_path):
    (folder / "intrinsics.txt").unlink()
    with pytest.raises(InvalidFile, match="neither"):
        load_rgbd(folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InvalidFile, match="depth images"):
        load_rgbd(tmp_path / "empty")
    np.savetxt(folder / "intrinsics.txt", np.diag([50.0, 50.0, 1.0]))
    with pytest.raises(InvalidArgument, match="fps"):
        load_rgbd(folder, fps=0)


def test_images_of_different_sizes_are_refused_when_they_are_read(folder):
    Image.fromarray(np.ones((10, 10), np.uint16)).save(folder / "depth/11.png")
    recording = load_rgbd(folder)
    assert len(recording.cloud(1).points) > 0
    with pytest.raises(InvalidFile, match="as the first one"):
        recording.cloud(2)


def _chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_only_grey_images_of_a_decent_size_are_read(tmp_path):
    huge = b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 16, 0, 0, 0, 0))
    (tmp_path / "huge.png").write_bytes(huge + _chunk(b"IDAT", zlib.compress(b"")) + _chunk(b"IEND", b""))
    with pytest.raises(InvalidFile, match=r"at most 16777216 pixels, got .*3600000000 pixels"):
        read_grey(tmp_path / "huge.png")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "colour.png")
    with pytest.raises(InvalidFile, match="grey"):
        read_grey(tmp_path / "colour.png")
    Image.fromarray(np.arange(3000, dtype=np.uint16).reshape(50, 60)).save(tmp_path / "good.png")
    data = (tmp_path / "good.png").read_bytes()
    assert np.array_equal(read_grey(tmp_path / "good.png"), np.arange(3000).reshape(50, 60))
    for broken in (b"", data[:20], data[:60], b"JFIF" + data, data[:45] + b"\0\0\0\0" + data[49:]):
        (tmp_path / "broken.png").write_bytes(broken)
        with pytest.raises(InvalidFile, match="PNG"):
            read_grey(tmp_path / "broken.png")
    with pytest.raises(InvalidFile, match="nothing there"):
        read_grey(tmp_path / "none.png")


def test_shades_of_8_bits_are_no_depths(tmp_path):
    (tmp_path / "depth").mkdir()
    Image.fromarray(np.full((LENS.height, LENS.width), 200, np.uint8)).save(tmp_path / "depth/0.png")
    with pytest.raises(InvalidFile, match=r"0\.png: expected depths of 16 bits, got 8 bits"):
        load_rgbd(tmp_path)

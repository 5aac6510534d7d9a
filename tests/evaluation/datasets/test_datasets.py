"""Recordings: depth images of a known scene give points and a template on it; folders come in order of number."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.io import savemat

from ddakf.data import sample
from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation import datasets, metrics
from ddakf.evaluation.datasets import KINECT
from ddakf.evaluation.datasets.captures.depth_template import template_from_depth
from ddakf.evaluation.sensors.camera import Camera
from ddakf.evaluation.tracking.sources import source_of
from ddakf.files import io
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh, vertex_normals


@pytest.fixture(scope="module")
def person():
    """A body 2.5 m in front of the sensor, in the sensor's frame: vertices, faces, depth image in metres."""
    sequence = sample()
    vertices = sequence.body_vertices[0].astype(float)
    vertices += np.array([0, 0, -2.5]) - vertices.mean(axis=0)
    depth = Camera.at_origin(KINECT).render([(vertices, sequence.body_faces)])[0]
    return vertices, sequence.body_faces, np.where(np.isfinite(depth), depth, 0)


@pytest.fixture
def depth_file(tmp_path, person):
    millimetres = np.rint(person[2] * 1e3).astype(np.uint16)[:, ::-1]  # mirrored, as the sensor delivers it
    savemat(tmp_path / "a1_depth.mat", {"d_depth": np.stack([millimetres] * 3, axis=2)})
    return tmp_path / "a1_depth.mat"


def test_depth_points_lie_on_the_person_unmirrored(depth_file, person):
    recording = replace(datasets.open_dataset(depth_file), smooth=False)
    cloud = recording.cloud(1)
    mesh, kept = Mesh.cleaned(person[0], person[1])
    assert len(recording) == 3
    assert recording.timestamp(2) == pytest.approx(2 / 30)
    assert np.array_equal(cloud.sensor_origin, np.zeros(3))
    assert metrics.SurfaceDistance(mesh)(cloud.points, person[0][kept]).max() < 0.001
    assert 0.8 * (person[2] > 0).sum() < len(cloud.points) <= (person[2] > 0).sum()


def test_smoothing_evens_out_depth_steps_and_keeps_the_surface(depth_file, person):
    recording = datasets.open_dataset(depth_file)
    stepped = replace(recording, depth=np.where(recording.depth, recording.depth // 22 * 22 + 11, 0).astype(np.uint16))
    mesh, kept = Mesh.cleaned(person[0], person[1])
    distance = metrics.SurfaceDistance(mesh)
    raw, smooth = (distance(r.cloud(0).points, person[0][kept]) for r in (replace(stepped, smooth=False), stepped))
    assert np.median(smooth) < 0.7 * np.median(raw)


def test_template_is_the_visible_surface_facing_the_sensor(depth_file, person):
    template = datasets.open_dataset(depth_file).template()
    mesh, kept = Mesh.cleaned(person[0], person[1])
    assert 2500 <= template.n_vertices <= 4000
    assert np.percentile(metrics.SurfaceDistance(mesh)(template.vertices, person[0][kept]), 90) < 0.01
    facing = (vertex_normals(template.vertices, template.faces) * -template.vertices).sum(axis=1) > 0
    assert facing.mean() > 0.99
    lengths = np.linalg.norm(np.diff(template.vertices[template.edges], axis=1), axis=2)
    assert lengths.max() < 0.07


def test_template_does_not_bridge_depth_jumps_and_forgets_specks():
    depth = np.zeros((KINECT.height, KINECT.width))
    depth[60:120, 60:120] = 2.0
    depth[60:120, 120:180] = 2.2
    depth[200:204, 10:14] = 2.0
    template = template_from_depth(depth, Camera.at_origin(KINECT))
    depths = -template.vertices[template.faces][:, :, 2]
    assert np.ptp(depths, axis=1).max() < 0.01
    assert {*np.round(depths, 1).ravel()} == {2.0, 2.2}
    assert template.vertices[:, 1].min() > -1  # the speck would be at the lower left
    assert len(template.vertices) > 2500


def test_template_of_noise_is_refused():
    noise = np.random.default_rng(0).uniform(0.5, 5.0, (KINECT.height, KINECT.width))
    with pytest.raises(InvalidArgument, match=r"depth: expected a surface without jumps of 0\.06 m, for 3000 vertices, got none"):
        template_from_depth(noise, Camera.at_origin(KINECT))


def test_template_of_nothing_is_refused():
    with pytest.raises(InvalidArgument, match="16 connected pixels"):
        template_from_depth(np.zeros((KINECT.height, KINECT.width)), Camera.at_origin(KINECT))


def test_broken_depth_files_give_one_sentence(tmp_path):
    with pytest.raises(InvalidFile, match="nothing there"):
        datasets.load_depth(tmp_path / "none.mat")
    (tmp_path / "bad.mat").write_bytes(b"MATLAB 5.0 but not really" * 9)
    with pytest.raises(InvalidFile, match="a MATLAB file"):
        datasets.load_depth(tmp_path / "bad.mat")
    savemat(tmp_path / "damaged.mat", {"d_depth": np.zeros((2, 2, 2), np.uint16)})
    good = (tmp_path / "damaged.mat").read_bytes()
    for byte, value in ((125, 9), (127, 9), (128, 99), (144, 255), (153, 255), (180, 200)):
        (tmp_path / "damaged.mat").write_bytes(good[:byte] + bytes([value]) + good[byte + 1 :])
        with pytest.raises(InvalidFile, match=r"damaged\.mat"):
            datasets.load_depth(tmp_path / "damaged.mat")
    savemat(tmp_path / "other.mat", {"depth": np.zeros(3)})
    with pytest.raises(InvalidFile, match="d_depth"):
        datasets.load_depth(tmp_path / "other.mat")
    savemat(tmp_path / "shape.mat", {"d_depth": np.zeros((24, 32, 2), np.uint16)})
    with pytest.raises(InvalidFile, match="of shape"):
        datasets.load_depth(tmp_path / "shape.mat")


def test_folders_are_read_in_the_order_of_their_numbers(tmp_path):
    for number in (10, 9, 1):
        io.write_points(tmp_path / f"frame_{number}.xyz", np.full((2, 3), number))
    (tmp_path / "notes.md").write_text("no frame")
    recording = datasets.open_dataset(tmp_path, fps=10)
    assert [recording.cloud(k).points[0, 0] for k in range(3)] == [1, 9, 10]
    assert recording.cloud(0).sensor_origin is None
    assert recording.timestamp(1) == 0.1
    with pytest.raises(InvalidArgument, match="template"):
        recording.template()


def test_a_folder_that_begins_with_a_mesh_is_its_own_template(tmp_path):
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    io.write_mesh(tmp_path / "0.ply", vertices, faces)
    assert np.array_equal(datasets.load_folder(tmp_path).template().vertices, vertices)
    io.write_points(tmp_path / "0.ply", vertices)
    with pytest.raises(InvalidArgument, match="template"):
        datasets.load_folder(tmp_path).template()


def test_a_template_beside_clouds_is_no_frame_and_lies_where_the_first_one_is(tmp_path):
    for number in range(3):
        io.write_points(tmp_path / f"{number}.ply", np.eye(3))
    io.write_mesh(tmp_path / "template.obj", 2 * np.eye(3), np.array([[0, 1, 2]]))
    frames = datasets.load_folder(tmp_path)
    assert len(frames) == 3
    assert np.array_equal(frames.template().vertices, 2 * np.eye(3))
    with pytest.raises(InvalidArgument, match=r"frame 0, where template\.obj lies"):
        frames.template(1)
    io.write_mesh(tmp_path / "template.ply", np.eye(3), np.array([[0, 1, 2]]))
    with pytest.raises(InvalidFile, match=r"template\.obj and template\.ply"):
        datasets.load_folder(tmp_path)


def test_files_without_a_number_are_frames_only_where_no_file_has_one(tmp_path):
    io.write_mesh(tmp_path / "garment.obj", np.eye(3), np.array([[0, 1, 2]]))
    io.write_mesh(tmp_path / "other.obj", np.eye(3), np.array([[0, 1, 2]]))
    assert len(datasets.load_folder(tmp_path)) == 2
    (tmp_path / "notes.txt").write_text("taken in the garden")
    io.write_points(tmp_path / "frame_7.ply", np.eye(3))
    assert [path.name for path in datasets.load_folder(tmp_path).paths] == ["frame_7.ply"]


def test_poses_beside_clouds_are_no_frames_and_files_of_macos_are_none(tmp_path):
    for number in range(3):
        io.write_points(tmp_path / f"{number}.xyz", np.eye(3))
        (tmp_path / f"._{number}.xyz").write_bytes(b"\0\5\x16\7")
    assert len(datasets.load_folder(tmp_path)) == 3
    (tmp_path / "0.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    with pytest.raises(InvalidFile, match=r"expected frames of one format, got 1 \.txt and 3 \.xyz"):
        datasets.load_folder(tmp_path)


def test_a_folder_of_clouds_has_the_times_of_its_file(tmp_path):
    for number in range(3):
        io.write_points(tmp_path / f"{number}.xyz", np.eye(3))
    assert datasets.load_folder(tmp_path, fps=10.0).timestamp(2) == 0.2
    (tmp_path / "timestamps.txt").write_text("5.0\r\n5.1\r\n5.4\r\n")
    folder = datasets.load_folder(tmp_path, fps=10.0)
    assert [folder.timestamp(frame) for frame in range(3)] == pytest.approx([0.0, 0.1, 0.4])
    assert folder.fps == pytest.approx(5.0)
    (tmp_path / "timestamps.txt").write_text("5.0\n5.1\n")
    with pytest.raises(InvalidFile, match=r"timestamps\.txt: expected 3 numbers, one per frame, got 2"):
        datasets.load_folder(tmp_path)


@pytest.mark.parametrize("suffix", [".xyz", ".ply"])
def test_pixels_that_saw_nothing_are_no_points(tmp_path, suffix):
    points = np.eye(3)
    points[1] = np.nan
    io.write_points(tmp_path / f"0{suffix}", points)
    assert np.array_equal(datasets.load_folder(tmp_path).cloud(0).points, np.eye(3)[[0, 2]])


def test_a_folders_own_template_that_is_repaired_has_its_vertex_map(tmp_path):
    triangle = np.array([[9.0, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    io.write_mesh(tmp_path / "template.obj", triangle, np.array([[1, 2, 3]]))
    for number in range(2):
        io.write_points(tmp_path / f"{number}.xyz", np.eye(3))
    assert source_of(datasets.load_folder(tmp_path)).vertex_map.tolist() == [1, 2, 3]
    io.write_mesh(tmp_path / "template.obj", triangle[1:], np.array([[0, 1, 2]]))
    assert source_of(datasets.load_folder(tmp_path)).vertex_map is None


def test_folders_without_frames_and_rates_without_sense(tmp_path):
    with pytest.raises(InvalidFile, match="none in the folder"):
        datasets.load_folder(tmp_path)
    with pytest.raises(InvalidFile, match="no folder"):
        datasets.load_folder(tmp_path / "none")
    io.write_points(tmp_path / "0.xyz", np.eye(3))
    for fps in (0, 1e-320, np.inf):
        with pytest.raises(InvalidArgument, match="fps"):
            datasets.load_folder(tmp_path, fps=fps)


def test_points_beyond_single_precision_are_refused_and_no_points_are_a_frame(tmp_path):
    (tmp_path / "0.xyz").write_text("1e300 0 0\n")
    (tmp_path / "1.xyz").write_text("")
    frames = datasets.load_folder(tmp_path)
    with pytest.raises(InvalidFile, match=r"0\.xyz: expected coordinates up to 1e\+12, got 1e\+300"):
        frames.cloud(0)
    assert frames.cloud(1).points.shape == (0, 3)


def test_depths_that_are_no_numbers_are_not_seen(tmp_path):
    depth = np.full((240, 320, 1), np.nan)
    depth[:, 160:], depth[100:140, 100:140] = np.inf, 2000
    savemat(tmp_path / "a.mat", {"d_depth": depth})
    assert np.count_nonzero(datasets.load_depth(tmp_path / "a.mat").depth) == 40 * 40


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["a1_s1_t1", "a12_s2_t1", "a26_s3_t1"])
def test_kinect_recordings_give_a_template_of_a_person(recording, name):
    frames = datasets.load_depth(recording(f"depth/utd-mhad/{name}_depth.mat"))
    template = frames.template()
    distance = metrics.SurfaceDistance(template)(frames.cloud(0).points, template.vertices)
    assert 2500 <= template.n_vertices <= 4000
    assert 1.3 < np.ptp(template.vertices[:, 1]) < 2.0
    assert np.median(distance) < 0.015


# What is at a path ----------------------------------------------------------------------------------------------------


def test_every_kind_is_recognised_by_its_path(tmp_path, depth_file):
    triangle = np.eye(3)
    np.savez(tmp_path / "s.npz", garment_V=np.stack([triangle] * 3), garment_F=[[0, 1, 2]], fps=25)
    sequence = datasets.open_dataset(tmp_path / "s.npz")
    assert (type(sequence), sequence.name, sequence.fps) == (Sequence, "s", 25)
    assert isinstance(datasets.open_dataset(depth_file, fps=15), datasets.DepthRecording)
    assert datasets.open_dataset(depth_file, fps=15).fps == 15
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    io.write_points(clouds / "0.xyz", triangle)
    assert isinstance(datasets.open_dataset(str(clouds), fps=20), datasets.FolderRecording)
    depth = tmp_path / "rgbd" / "depth"
    depth.mkdir(parents=True)
    Image.fromarray(np.full((9, 9), 1000, np.uint16)).save(depth / "0.png")
    np.savetxt(depth.parent / "intrinsics.txt", np.diag([9.0, 9.0, 1.0]))
    assert len(datasets.open_dataset(depth.parent).cloud(0).points) == 81


def test_one_of_several_parts_stands_behind_the_mark(tmp_path):
    vertices, faces = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    for number in (30, 31, 37):
        (tmp_path / "MPI-FAUST/training/registrations").mkdir(parents=True, exist_ok=True)
        io.write_mesh(tmp_path / f"MPI-FAUST/training/registrations/tr_reg_0{number}.ply", vertices * (number - 29), faces)
    root = tmp_path / "MPI-FAUST"
    assert datasets.parts(root) == ("s3_p1", "s3_p7")
    assert datasets.open_dataset(f"{root}#s3_p7").name == "faust_s3_p7"
    assert datasets.open_dataset(root / "training/registrations/tr_reg_037.ply").name == "faust_s3_p7"
    with pytest.raises(InvalidArgument, match=r"MPI-FAUST#PART with one of 2 parts \(s3_p1, s3_p7\)"):
        datasets.open_dataset(root)
    with pytest.raises(InvalidArgument, match="s3_p2"):
        datasets.open_dataset(f"{root}#s3_p2")
    np.savez(tmp_path / "all.npz", V=np.stack([vertices] * 10), F=faces)
    assert len(datasets.parts(tmp_path / "all.npz")) == 9
    assert datasets.open_dataset(f"{tmp_path}/all.npz#s0_p4").name == "faust_s0_p4"


def test_a_path_with_a_mark_of_its_own_is_not_split(tmp_path):
    (tmp_path / "take#2").mkdir()
    io.write_points(tmp_path / "take#2" / "0.xyz", np.eye(3))
    assert datasets.open_dataset(tmp_path / "take#2").name == "take#2"
    with pytest.raises(InvalidArgument, match="none of a folder with one recording, got '1'"):
        datasets.open_dataset(f"{tmp_path}/take#2#1")
    assert datasets.parts(tmp_path / "take#2") == ()


def test_what_is_of_no_kind_is_refused_with_what_would_be(tmp_path):
    with pytest.raises(InvalidFile, match=r"none: expected a sequence \(\.npz\), FAUST .*, got nothing there"):
        datasets.open_dataset(tmp_path / "none")
    with pytest.raises(InvalidFile, match="nothing there"):
        datasets.open_dataset(tmp_path / "none#part")
    (tmp_path / "a.mp4").write_bytes(b"")
    with pytest.raises(InvalidFile, match=r"got a file \.mp4"):
        datasets.open_dataset(tmp_path / "a.mp4")
    (tmp_path / "a.npz").write_bytes(b"no archive")
    with pytest.raises(InvalidFile, match=r"an \.npz archive"):
        datasets.open_dataset(tmp_path / "a.npz")
    with pytest.raises(InvalidArgument, match="none of a file"):
        datasets.open_dataset(f"{tmp_path}/a.npz#part")

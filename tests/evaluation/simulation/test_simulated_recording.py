"""The whole simulation, if Newton is installed: cut, settle, simulate, measure, write, read; and refused parameters."""

import json

import numpy as np
import pytest

from ddakf.commands import cli
from ddakf.data.body import load_body
from ddakf.data.body_shape import random_shape, shaped
from ddakf.data.pack import pack
from ddakf.errors import InvalidArgument, PoorQuality
from ddakf.evaluation.simulation import garments, motions, simulated_recording, solver
from ddakf.files.sequence import Sequence, load_sequence


def posed(n_frames=4, body=None):
    """A triangle that rides on the walking body, and the body's pose."""
    body = body or load_body()
    pose = motions.make("walk", body, n_frames)
    pose = type(pose)(pose.rotations.astype(np.float32), pose.shift.astype(np.float32))
    vertices = body.skinned(pose)
    garment = vertices[:, body.faces[0]] + np.float32([0, 0, 0.5])
    faces = np.array([[0, 1, 2]])
    return Sequence("t", garment, faces, 30.0, garment[0], vertices, body.faces, "tshirt", "walk"), pose


def test_a_recording_is_written_with_names_and_figures_and_read_back(tmp_path):
    sequence, pose = posed()
    simulated_recording.write(tmp_path / "a.npz", simulated_recording.Order("tshirt", "walk", 4), sequence, pose, "1.8")
    read = load_sequence(tmp_path / "a.npz")
    assert (read.garment, read.motion, read.fps, len(read)) == ("tshirt", "walk", 30.0, 4)
    assert np.abs(read.garment_vertices - sequence.garment_vertices).max() < 1e-4
    assert np.abs(read.body_vertices - sequence.body_vertices).max() < 1e-4
    note = json.loads((tmp_path / "a.json").read_text())
    assert note["quality"]["frames"] == 4
    assert "CC0" in note["licence"]


def test_packing_keeps_the_pose_in_place_of_the_body(tmp_path):
    sequence, pose = posed()
    simulated_recording.write(tmp_path / "a.npz", simulated_recording.Order("tshirt", "walk", 4), sequence, pose, "1.8")
    pack(tmp_path / "a.npz", tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as archive:
        assert not any(key.startswith("body_V") for key in archive.files)
    read = load_sequence(tmp_path / "b.npz")
    assert np.abs(read.body_vertices - sequence.body_vertices).max() < 1e-6
    assert (read.garment, read.motion) == ("tshirt", "walk")


def test_a_recording_of_another_body_travels_as_its_shape_and_poses(tmp_path):
    order = simulated_recording.Order("tshirt", "walk", 4, body=7)
    body = shaped(load_body(), random_shape(7))
    sequence, pose = posed(body=body)
    simulated_recording.write(tmp_path / "a.npz", order, sequence, pose, "1.8")
    with np.load(tmp_path / "a.npz") as archive:
        assert not any(key.startswith("body_V") for key in archive.files)
    read = load_sequence(tmp_path / "a.npz")
    assert np.abs(read.body_vertices - sequence.body_vertices).max() < 1e-6
    assert np.abs(read.body_vertices - load_body().skinned(pose)).max() > 0.02
    pack(tmp_path / "a.npz", tmp_path / "b.npz")
    assert np.array_equal(load_sequence(tmp_path / "b.npz").body_vertices, read.body_vertices)


def test_a_bad_recording_is_not_written(tmp_path):
    sequence, pose = posed()
    torn = Sequence(**{**vars(sequence), "garment_vertices": sequence.garment_vertices * 3})
    with pytest.raises(PoorQuality):
        simulated_recording.write(tmp_path / "a.npz", simulated_recording.Order("tshirt", "walk", 4), torn, pose, "1.8")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "change",
    [{"garment": "toga"}, {"motion": "moonwalk"}, {"fit": "tight"}, {"fabric": "steel"}, {"n_frames": 1}, {"fps": 1.0}],
)
def test_orders_that_cannot_be_filled_are_refused(change):
    with pytest.raises(InvalidArgument):
        simulated_recording.Order(**{"garment": "skirt", "motion": "walk", **change})


@pytest.mark.parametrize(
    ("name", "said"), [("skirt.obj", "ends in .npz"), ("file/skirt.npz", "folder"), ("folder.npz", "written")]
)
def test_the_command_refuses_what_cannot_be_written_before_any_work(tmp_path, capsys, name, said):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.npz").mkdir()
    assert cli.main(["simulate", "--garment", "skirt", "--motion", "walk", "--out", str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("ddakf: --out: expected")
    assert said in error


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_simulator_makes_a_recording_that_is_fit_for_use(tmp_path, capsys):
    pytest.importorskip("newton", reason="Newton (extra simulation) is not installed")
    target = tmp_path / "tank.npz"
    arguments = ["--garment", "tank", "--motion", "twist", "--frames", "10", "--vertices", "250", "--out", str(target)]
    assert cli.main(["simulate", *arguments]) == 0, capsys.readouterr().err
    sequence = load_sequence(target)
    assert len(sequence) == 10
    assert sequence.body_vertices.shape[1] == load_body().vertices.shape[0]
    moved = np.linalg.norm(sequence.garment_vertices[-1] - sequence.garment_vertices[0], axis=1)
    assert moved.max() > 0.005  # the cloth goes with the body
    fallen = sequence.garment_rest[:, 1].mean() - sequence.garment_vertices[:, :, 1].mean()
    assert abs(fallen) < 0.05  # and hangs on it


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_simulator_goes_on_from_a_state_as_it_went():
    pytest.importorskip("newton", reason="Newton (extra simulation) is not installed")
    body = load_body()
    garment = garments.make("tank", body, 250)
    pose = motions.make("jump", body, 24, 30.0)
    posed, pins = body.skinned(pose), body.skinned(pose, body.attach(garment.mesh.vertices, garment.mesh.faces))
    whole = np.array(list(solver.simulate(garment, posed, body.faces, pins, 30.0)))
    state = solver.Start(whole[11], (whole[11] - whole[10]) * 30.0)  # after frame 12
    rest = np.array(list(solver.simulate(garment, posed[12:], body.faces, pins[12:], 30.0, start=state)))
    off = np.linalg.norm(rest - whole[12:], axis=2)
    still = np.linalg.norm(whole[11] - whole[12:], axis=2)
    assert np.median(off[:6]) < 0.2 * np.median(still[:6])
    assert off[:6].max() < 0.03

"""``ddakf track`` from end to end on short runs: what it reports, what it writes, what it refuses."""

import json
import os
import queue
import re
import sys
import threading
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.io import savemat

import ddakf
from ddakf.commands import cli, track
from ddakf.data import SAMPLE, sample
from ddakf.evaluation.datasets import KINECT, open_dataset
from ddakf.evaluation.metrics import rmse_mm
from ddakf.evaluation.sensors import Camera, Sensor
from ddakf.evaluation.tracking import replay
from ddakf.evaluation.tracking.scoreboard import Scoreboard
from ddakf.evaluation.tracking.server import Server
from ddakf.evaluation.tracking.sources import source_of
from ddakf.files import io

pytestmark = pytest.mark.slow

SHORT = ["--frames", "0:5", "--points", "3000"]


def _track(*arguments):
    return cli.main(["track", *map(str, arguments)])


def _summary(capsys, *arguments):
    assert _track(*arguments, "--json") == 0
    return json.loads(capsys.readouterr().out)


def test_a_run_that_ends_early_keeps_what_it_has(capsys, tmp_path):
    folder = tmp_path / "scan[1]"
    folder.mkdir()
    for number in range(4):
        io.write_mesh(folder / f"{number}.ply", sample().garment_vertices[number], sample().garment_faces)
    (folder / "3.ply").write_bytes(b"")
    assert _track(folder, "--out", tmp_path / "r.npz", "--json") == 2
    printed = capsys.readouterr()
    assert "the results are of 2 of 3 frames" in printed.err
    assert json.loads(printed.out)["frames"] == 2
    assert len(np.load(tmp_path / "r.npz")["vertices"]) == 2


def test_no_output_replaces_what_is_tracked(capsys, tmp_path):
    recording, folder = tmp_path / "a.npz", tmp_path / "clouds"
    folder.mkdir()
    recording.write_bytes(SAMPLE.read_bytes())
    for number in range(2):
        io.write_mesh(folder / f"{number:04d}.obj", sample().garment_vertices[number], sample().garment_faces)
    for arguments, names in (
        ((recording, "--out", tmp_path / "clouds" / ".." / "a.npz"), "out: expected another file"),
        ((folder, "--meshes", folder), "meshes: expected another folder"),
        ((folder, "--template", folder / "0000.obj", "--picture", folder / "0000.obj"), "picture: expected another file"),
        ((folder, "--out", folder / "0001.obj"), "out: expected a file that does not exist yet in the folder that is tracked"),
    ):
        assert _track(*arguments) == 2
        assert names in capsys.readouterr().err
    assert recording.read_bytes() == SAMPLE.read_bytes()


def test_a_frame_that_is_refused_is_named(capsys, tmp_path):
    io.write_mesh(tmp_path / "template.obj", sample().garment_vertices[0], sample().garment_faces)
    for number in range(3):
        io.write_points(tmp_path / f"{number}.xyz", 1000 * sample().garment_vertices[number])
    assert _track(tmp_path) == 2
    assert "ddakf: frame 1: points" in capsys.readouterr().err


def test_frames_without_points_are_counted_and_a_run_of_nothing_else_fails(capsys, tmp_path):
    run = (tmp_path, "--template", tmp_path / "template.obj")
    io.write_mesh(tmp_path / "template.obj", sample().garment_vertices[0], sample().garment_faces)
    empty = np.zeros((0, 3))
    for number, points in enumerate((empty, sample().garment_vertices[1], empty)):
        io.write_points(tmp_path / f"{number}.xyz", points)
    assert _summary(capsys, *run)["empty_frames"] == 2
    assert _track(*run) == 0
    assert re.search("frames without points +│ 2 ", capsys.readouterr().out)
    io.write_points(tmp_path / "1.xyz", empty)
    assert _track(*run) == 2
    printed = capsys.readouterr()
    assert re.search("frames without points +│ 3 ", printed.out)
    assert re.search("path: expected frames with points of the garment, got .*, all of whose 3 have none", printed.err)


@pytest.mark.parametrize("view", ["full", "front", "ring4"])
def test_a_sequence_is_tracked_and_judged(capsys, view):
    summary = _summary(capsys, SAMPLE, *SHORT, "--view", view)
    assert summary["frames"] == 4
    assert sum(summary["states"].values()) == pytest.approx(1)
    assert 0 < summary["normal_rmse_mm"] <= summary["rmse_mm"] < 30
    assert 0 <= summary["coverage90"] <= 1
    assert 0 < summary["residual_mean_mm"] < summary["residual_p95_mm"] < 50
    assert 0 < summary["ms_p50"] <= summary["ms_p99"]


def test_a_name_is_that_of_a_recording_as_of_an_evaluation(capsys):
    by_name, by_path = (_summary(capsys, recording, *SHORT) for recording in ("sample", SAMPLE))
    assert by_name["rmse_mm"] == by_path["rmse_mm"]



def test_runs_with_the_same_seed_are_the_same(capsys):
    first, again, other = (_summary(capsys, SAMPLE, *SHORT, "--seed", seed)["rmse_mm"] for seed in (1, 1, 2))
    assert first == again != other


def test_results_and_pictures_are_written(capsys, tmp_path):
    out, still, moving = (tmp_path / name for name in ("r.npz", "p.png", "a.gif"))
    assert _track(SAMPLE, *SHORT, "--body", "--out", out, "--picture", still, "--animation", moving) == 0
    printed = capsys.readouterr().out
    assert "RMSE" in printed
    assert "cloud to surface" in printed
    saved = np.load(out)
    assert saved["vertices"].shape == (4, 2658, 3)
    assert saved["sigma"].shape == (4, 2658)
    assert saved["timestamps"] == pytest.approx(np.arange(1, 5) / 30)
    with Image.open(still) as picture, Image.open(moving) as animation:
        assert picture.size == animation.size
        assert animation.n_frames == 4


def test_the_garment_of_each_frame_is_written_as_a_mesh(capsys, tmp_path):
    out = tmp_path / "r.npz"
    assert _track(SAMPLE, "--frames", "2:5", "--points", "3000", "--out", out, "--meshes", tmp_path) == 0
    assert sorted(path.name for path in tmp_path.glob("*.obj")) == ["0003.obj", "0004.obj"]
    saved = np.load(out)
    vertices, faces = io.read_mesh(tmp_path / "0004.obj")
    assert vertices == pytest.approx(saved["vertices"][-1], abs=1e-6)
    assert (faces == saved["faces"]).all()


def test_a_place_that_may_not_be_written_to_is_refused_before_the_run(capsys, monkeypatch, tmp_path):
    """As on a medium that is mounted for reading."""
    monkeypatch.setattr(os, "access", lambda path, mode: not str(path).startswith(str(tmp_path)))
    for option, where in (("--out", tmp_path / "r.npz"), ("--picture", tmp_path / "p.png"), ("--meshes", tmp_path)):
        assert _track(SAMPLE, *SHORT, option, where) == 2
        captured = capsys.readouterr()
        assert re.fullmatch(rf"ddakf: {option[2:]}: expected .* may be written.*, got {where}\n", captured.err)
        assert captured.out == ""


def test_meshes_of_another_run_are_told(capsys, tmp_path):
    (tmp_path / "0007.obj").write_text("")
    (tmp_path / "notes.obj").write_text("")
    assert _track(SAMPLE, "--frames", "2:5", "--points", "3000", "--meshes", tmp_path) == 0
    assert f"{tmp_path}: 1 other numbered meshes lie there" in capsys.readouterr().err.replace("\n", "")


def test_results_are_saved_though_one_of_them_cannot_be_and_nobody_reads_the_summary(capsys, monkeypatch, tmp_path):
    still = tmp_path / "p.png"

    def unwritable(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Scoreboard, "save", unwritable)
    assert _track(SAMPLE, *SHORT, "--out", tmp_path / "r.npz", "--picture", still) == 2
    printed = capsys.readouterr()
    assert "RMSE" in printed.out
    assert printed.err.splitlines()[-1] == f"ddakf: {tmp_path / 'r.npz'}: No space left on device"
    with Image.open(still) as picture:
        assert picture.size[0] > 100
    monkeypatch.undo()
    monkeypatch.setattr(track, "table", _raise(SystemExit(1)))  # as Rich ends a program whose reader has gone
    with pytest.raises(SystemExit):
        _track(SAMPLE, *SHORT, "--out", tmp_path / "r.npz")
    assert len(np.load(tmp_path / "r.npz")["vertices"]) == 4


def _raise(error):
    def work(*_):
        raise error

    return work


def test_a_rate_is_not_given_where_the_recording_has_its_own(capsys, tmp_path):
    for number in range(3):
        io.write_mesh(tmp_path / f"{number}.obj", sample().garment_vertices[number], sample().garment_faces)
    assert _track(tmp_path, "--fps", "15") == 0
    (tmp_path / "timestamps.txt").write_text("0 0.1 0.2")
    capsys.readouterr()
    assert _track(tmp_path, "--fps", "15") == 2
    assert capsys.readouterr().err == "ddakf: fps: expected none for a recording that states its own, got 15\n"


def test_the_paper_runs_too(capsys):
    assert _summary(capsys, SAMPLE, *SHORT, "--paper")["frames"] == 4


def test_a_depth_recording_is_tracked_with_a_template_from_its_first_frame(capsys, tmp_path):
    s = sample()
    images = []
    for k in range(4):
        body = s.body_vertices[k].astype(float) - s.body_vertices[0].mean(axis=0) - [0, 0, 2.5]
        depth = Camera.at_origin(KINECT).render([(body, s.body_faces)])[0]
        images.append(np.where(np.isfinite(depth), np.rint(depth * 1e3), 0).astype(np.uint16)[:, ::-1])
    savemat(tmp_path / "d.mat", {"d_depth": np.stack(images, axis=2)})
    summary = _summary(capsys, tmp_path / "d.mat", "--picture", tmp_path / "p.png")
    assert summary["frames"] == 3
    assert summary["rmse_mm"] is None
    assert summary["residual_mean_mm"] < 15
    assert (tmp_path / "p.png").exists()


def _clouds(folder, frames, *, unit=1.0):
    """A folder with a cloud of each of the sample's first frames, and a template in the place of the first one."""
    folder.mkdir()
    for k in range(frames):
        io.write_points(folder / f"{k}.xyz", unit * sample().garment_vertices[k])
    io.write_mesh(folder.with_suffix(".ply"), unit * sample().garment_vertices[0], sample().garment_faces)
    return folder, "--template", folder.with_suffix(".ply")


def _require_tracked(vertices):
    """The last of (T, V, 3) vertices of a folder are where the sample is then, and not where it was in the first frame."""
    truth, start = sample().garment_vertices[len(vertices) - 1], sample().garment_vertices[0]
    assert rmse_mm(vertices[-1], truth) < 0.2 * rmse_mm(start, truth)


def test_a_folder_of_clouds_is_tracked_with_a_template_file(capsys, tmp_path):
    arguments = _clouds(tmp_path / "frames", 5)
    summary = _summary(capsys, *arguments, "--out", tmp_path / "r.npz")
    assert summary["frames"] == 5
    assert summary["residual_mean_mm"] < 5
    _require_tracked(np.load(tmp_path / "r.npz")["vertices"])
    assert _track(*arguments) == 0
    assert "RMSE" not in capsys.readouterr().out


def test_a_repaired_template_comes_with_its_vertex_map(capsys, tmp_path):
    s, folder = sample(), tmp_path / "frames"
    folder.mkdir()
    for k in range(2):
        io.write_points(folder / f"{k}.xyz", s.garment_vertices[k])
    seam = s.garment_vertices[0][:1] + 0.01  # a vertex of no face
    io.write_mesh(tmp_path / "t.ply", np.concatenate([seam, s.garment_vertices[0]]), s.garment_faces + 1)
    assert _track(folder, "--template", tmp_path / "t.ply", "--out", tmp_path / "r.npz") == 0
    assert "repaired: 2658 vertices" in capsys.readouterr().err
    saved = np.load(tmp_path / "r.npz")
    assert saved["vertex_map"].tolist() == list(range(1, 2659))


def test_fabric_and_configuration_are_those_of_the_command_line(capsys):
    ways = [], ["--fabric", "wool"], ["--config", '{"preset": "fast"}']
    assert len({_summary(capsys, SAMPLE, *SHORT, *way)["rmse_mm"] for way in ways}) == 3


def test_a_folder_may_be_in_another_unit(capsys, tmp_path):
    vertices = []
    for unit, factor in (("m", 1.0), ("mm", 1000.0)):
        origin = [str(factor * x) for x in (0.0, 1.0, 3.0)]
        out = tmp_path / f"{unit}.npz"
        arguments = _clouds(tmp_path / unit, 5, unit=factor)
        assert _track(*arguments, "--unit", unit, "--sensor-origin", *origin, "--out", out) == 0
        vertices.append(np.load(out)["vertices"])
    assert vertices[0] == pytest.approx(vertices[1], abs=1e-3)
    _require_tracked(vertices[1])
    capsys.readouterr()
    assert _track(*arguments) == 2
    assert "unit: expected that of the files, one of m, cm, mm, in, got metres" in capsys.readouterr().err


def test_a_template_may_be_in_another_unit_than_the_clouds(capsys, tmp_path):
    clouds, *_ = _clouds(tmp_path / "mm", 5, unit=1000.0)
    _, *template = _clouds(tmp_path / "m", 5)
    out = tmp_path / "r.npz"
    assert _track(clouds, *template, "--unit", "mm", "--template-unit", "m", "--out", out) == 0
    _require_tracked(np.load(out)["vertices"])
    _, *large = _clouds(tmp_path / "large", 2, unit=1000.0)
    capsys.readouterr()
    assert _track(tmp_path / "m", *large) == 2
    assert "(--template-unit is that of the template alone)" in capsys.readouterr().err
    assert _track(clouds, *large, "--unit", "mm", "--template-unit", "m") == 2
    assert "template_unit: expected that of the files" in capsys.readouterr().err


def test_a_template_of_other_axes_is_told_how_to_turn_it(capsys, tmp_path):
    """Clouds with z up were recovering at a reliability of 0, without a word of the cause."""
    clouds, *template = _clouds(tmp_path / "clouds", 6)
    for path in clouds.iterdir():
        io.write_points(path, io.read_points(path)[:, [0, 2, 1]] * [1, -1, 1])
    assert _track(clouds, *template) == 0
    assert "template: expected the axes of the points; turned to [x, -z, y] it fits" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--view", "full"], "view: expected none for a recording, whose sensor saw what it saw, got full"),
        (["--start", "search"], "start: expected none for a recording, whose template is searched in the first frame"),
    ],
)
def test_what_has_no_effect_on_a_recording_is_refused(capsys, tmp_path, options, sentence):
    """A view and a start of a recording had no effect, and nothing was said."""
    assert _track(*_clouds(tmp_path / "clouds", 2), *options) == 2
    assert sentence in capsys.readouterr().err


def test_a_folder_has_the_origin_of_its_files_or_of_the_command_line(capsys, tmp_path):
    """And without either, the side is estimated and the table says so, once."""
    s, sensor = sample(), Sensor("front", points=4000)
    folders = [tmp_path / name for name in ("unplaced", "placed")]
    for folder in folders:
        folder.mkdir()
    io.write_mesh(tmp_path / "t.ply", s.garment_vertices[0], s.garment_faces)
    for k in range(3):
        points, eye = sensor.capture(s, k, np.random.default_rng(k))
        for folder in folders:
            io.write_points(folder / f"{k}.ply", points)
        file = folders[1] / f"{k}.ply"
        said = "comment sensor_origin {} {} {}\n".format(*eye).encode()
        file.write_bytes(file.read_bytes().replace(b"element vertex", said + b"element vertex"))
    unplaced, placed = ([folder, "--template", tmp_path / "t.ply"] for folder in folders)
    (warning,) = _summary(capsys, *unplaced)["warnings"]
    assert (warning["code"], warning["field"], warning["frames"]) == ("sensor_origin_missing", "sensor_origin", 3)
    assert _track(*unplaced) == 0
    assert capsys.readouterr().out.count("sensor_origin_missing") == 1
    by_file, by_hand = _summary(capsys, *placed), _summary(capsys, *unplaced, "--sensor-origin", *eye)
    assert by_file["warnings"] == by_hand["warnings"] == []
    assert by_file["residual_mean_mm"] == pytest.approx(by_hand["residual_mean_mm"])


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["none.npz"], "nothing there"),
        (["sampel"], "did you mean"),
        ([SAMPLE, "--sensor-origin", "0", "0", "2"], "sensor_origin"),
        ([SAMPLE, "--unit", "mm"], "unit: expected a folder of clouds"),
        ([SAMPLE, "--frames", "9:9"], "frames"),
        ([SAMPLE, "--drop", "2"], "drop"),
        ([SAMPLE, "--occlude", "9"], "FROM:TO"),
        ([SAMPLE, "--occlude", "9:3"], "occlude"),
        ([SAMPLE, "--occluded", "0.3"], "occluded: expected to be used with --occlude"),
        ([SAMPLE, "--template-unit", "mm"], "template_unit: expected to be used with --template"),
        ([SAMPLE, "--view", "full", "--fliers", "0.1"], "no camera"),
        ([SAMPLE, "--codec", "raw"], "codec"),
        ([SAMPLE, "--animation", "a.mp4"], "animation"),
        ([SAMPLE, "--out", "/nowhere/r.npz"], "out"),
        ([SAMPLE, "--picture", "same.gif", "--animation", "same.gif"], "animation: expected another file than the other results"),
        ([SAMPLE, "--meshes", "/nowhere"], "meshes: expected a folder that exists"),
        ([SAMPLE, "--template", "t.ply"], "template"),
        ([SAMPLE, "--config", "up=z"], "config: expected a JSON object"),
        ([SAMPLE, "--config", "[1]"], "config"),
        ([SAMPLE, "--config", '{"start": {"up": "north"}}'], "config.start.up"),
        ([SAMPLE, "--config", "{}", "--paper"], "config: expected none with --paper"),
        ([SAMPLE, "--fabric", "paper"], "fabric"),
        ([SAMPLE, "--api-key", "k"], "api_key: expected to be used with --server"),
        ([SAMPLE, "--tls-ca", "ca.pem"], "tls_ca: expected to be used with --server"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_sentence_before_the_run(capsys, arguments, names):
    assert _track(*arguments) == 2
    captured = capsys.readouterr()
    assert names in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


class FakeServiceError(Exception):
    pass


def _fake_client(tracker_of, fail_at=None):
    """A client with a tracker behind it that pulls frames in a thread as fast as it gets them, as the real one does."""
    log = SimpleNamespace(pulled=0, ahead=0, options=None, reset=None)

    class Session:
        def __init__(self, garment, body, config, **options):
            log.options, self.tracker = options, tracker_of(garment, body, config)

        def reset(self, vertices):
            log.reset = vertices
            self.tracker.reset(vertices)

        def track(self, frames, covariance):
            assert covariance
            pulled = queue.Queue()
            puller = threading.Thread(target=_pull, args=(frames, pulled, log))
            puller.start()
            number = 0
            while (frame := pulled.get(timeout=20)) is not None:
                if number == fail_at:
                    raise FakeServiceError("points: expected fewer, got more")
                log.ahead = max(log.ahead, log.pulled - number)
                result = self.tracker.step(frame.points, timestamp=frame.timestamp, sensor_origin=frame.sensor_origin)
                number += 1
                yield SimpleNamespace(**vars(result), latency=0.02)
            puller.join()

    @contextmanager
    def connect(target, *, api_key):
        def create_session(garment, *, body, config, **options):
            return contextmanager(lambda: (yield Session(garment, body, config, **options)))()

        yield SimpleNamespace(create_session=create_session)

    return SimpleNamespace(connect=connect, ServiceError=FakeServiceError), log


def _pull(frames, pulled, log):
    for frame in frames:
        log.pulled += 1
        pulled.put(frame)
    pulled.put(None)


def _tracker(garment, body, config):
    return ddakf.Tracker(garment, body=body, config=config)


def test_a_server_gets_the_same_frames_one_at_a_time(monkeypatch):
    client, log = _fake_client(_tracker)
    monkeypatch.setitem(sys.modules, "ddakf_client", client)
    source = source_of(open_dataset(SAMPLE), Sensor(points=2000), frames="0:5")
    here = [result.vertices.copy() for _, result, _ in replay.local(source)]
    there = [(frame.number, result.vertices.copy(), seconds) for frame, result, seconds in replay.remote(source, Server("x:1"))]
    assert [number for number, _, _ in there] == [1, 2, 3, 4]
    assert all(np.array_equal(a, b) for a, (_, b, _) in zip(here, there, strict=True))
    assert {seconds for _, _, seconds in there} == {0.02}
    assert log.ahead == 1
    assert log.options == {"flow": "lossless"}
    assert np.array_equal(log.reset, source.start)


def test_the_command_passes_server_and_codec_on(monkeypatch, capsys):
    client, log = _fake_client(_tracker)
    monkeypatch.setitem(sys.modules, "ddakf_client", client)
    summary = _summary(capsys, SAMPLE, *SHORT, "--server", "x:1", "--codec", "raw")
    assert summary["ms_p50"] == 20
    assert log.options == {"flow": "lossless", "codec": "raw"}


def test_what_the_server_refuses_is_one_sentence_and_leaves_no_thread(monkeypatch, capsys):
    client, _ = _fake_client(_tracker, fail_at=2)
    monkeypatch.setitem(sys.modules, "ddakf_client", client)
    before = threading.active_count()
    assert _track(SAMPLE, *SHORT, "--server", "x:1") == 2
    assert "points: expected fewer, got more\n" in capsys.readouterr().err
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join(timeout=2)
    assert threading.active_count() <= before + 1


def test_without_the_client_a_server_cannot_be_used(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ddakf_client", None)
    assert _track(SAMPLE, *SHORT, "--server", "x:1") == 2
    assert "pip install -e protos" in capsys.readouterr().err


def test_a_search_finds_the_garment(capsys):
    source = replace(source_of(open_dataset(SAMPLE), Sensor("full", points=4000), frames="0:12"), start_at="search")
    *_, (frame, result, _) = replay.local(source)
    assert np.linalg.norm(result.vertices.mean(axis=0) - frame.truth.mean(axis=0)) < 0.05

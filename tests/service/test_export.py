"""``ddakf demo --export``: plain files from which a client tracks the sample."""

from __future__ import annotations

import json

import numpy as np
import pytest
from ddakf_api.codec import sensor_origins
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame
from google.protobuf import json_format

import ddakf
from ddakf import data
from ddakf.commands import cli
from ddakf.evaluation.metrics import rmse_mm
from ddakf.files.io import read_mesh, read_points

FRAMES = 6


@pytest.mark.parametrize("view", ["front", "ring4"])
def test_the_sample_is_tracked_from_plain_files(client, tmp_path, capsys, view):
    assert cli.main(["demo", "--export", str(tmp_path), "--frames", str(FRAMES), "--view", view, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"folder": str(tmp_path), "frames": FRAMES}
    sequence = json.loads((tmp_path / "sequence.json").read_text())
    garment, body = (ddakf.Mesh(*read_mesh(tmp_path / sequence[name])) for name in ("garment", "body"))
    truth = [np.array(json.loads((tmp_path / f["truth"]).read_text())["vertices"]) for f in sequence["frames"]]
    assert np.abs(truth[3] - data.sample().garment_vertices[3]).max() < 1e-5

    def frames():
        for entry in sequence["frames"]:
            points, vertices = (read_points(tmp_path / entry[name]) for name in ("points", "body"))
            sensors = [json_format.ParseDict(sensor, pb.Sensor()) for sensor in entry["sensors"]]
            yield Frame(points, entry["capture_time"], sensor_origins(sensors, len(points)), vertices)

    with client.create_session(garment, body=body, flow="lossless") as session:
        session.reset(truth[0])
        results = list(session.track(frames()))
    assert len(results) == FRAMES
    assert max(rmse_mm(result.vertices, true) for result, true in zip(results, truth, strict=True)) < 20
    assert "sequence.json" in (tmp_path / "README.txt").read_text()
    capsys.readouterr()
    assert cli.main(["track", str(tmp_path / "points"), "--template", str(tmp_path / "garment.obj"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["frames"] == FRAMES


def test_a_shorter_export_leaves_no_frames_of_a_longer_one(tmp_path):
    for count in (3, 2):
        assert cli.main(["demo", "--export", str(tmp_path), "--frames", str(count)]) == 0
    assert sorted(path.name for path in (tmp_path / "points").iterdir()) == ["0000.ply", "0001.ply"]
    assert len(list((tmp_path / "truth").iterdir())) == len(list((tmp_path / "body").iterdir())) == 2


def test_a_folder_of_something_else_is_left_alone(tmp_path, capsys):
    for content in ("no JSON", "{}", '{"frames": [1]}'):
        (tmp_path / "sequence.json").write_text(content)
        assert cli.main(["demo", "--export", str(tmp_path), "--frames", "1"]) == 2
        assert "export: expected a new folder, or one of an earlier export" in capsys.readouterr().err
        assert [path.name for path in tmp_path.iterdir()] == ["sequence.json"]


def test_a_wrong_number_of_frames_writes_nothing(tmp_path, capsys):
    assert cli.main(["demo", "--export", str(tmp_path / "new"), "--frames", "0"]) == 2
    assert "frames: expected a number from 1 to 150, got 0" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()

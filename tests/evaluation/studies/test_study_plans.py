"""Plans of studies: bad ones are refused by name, and rows say what did not apply or failed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ddakf.commands import cli, evaluate
from ddakf.data import sample
from ddakf.errors import InvalidArgument, InvalidMesh
from ddakf.evaluation.studies import paper_studies
from ddakf.evaluation.studies.execution import run_study
from ddakf.evaluation.trials import recordings
from ddakf.files import io
from tests.evaluation.studies.small import QUIET, SMALL, plan

pytestmark = pytest.mark.slow


def test_a_plan_has_every_system_on_every_sequence_view_and_seed_once():
    whole = plan("ddakf", "nicp", views=("full", "front+body"), runs=2).trials()
    assert len(set(whole)) == len(whole) == 2 * 2 * 2
    assert {(t.view, t.body) for t in whole} == {("full", False), ("front", True)}
    assert {t.seed for t in whole[:4]} == {1}
    assert all((t.first, t.frames) == (0, 4) for t in whole)


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("how", "field"),
    [
        ({"systems": ("magic",)}, "methods: expected ddakf"),
        ({"systems": ('x={"robust": {"cutof": 1}}',)}, r"methods: config.robust.cutof: .*did you mean cutoff"),
        ({"systems": ()}, "methods"),
        ({"systems": ("nicp", "nicp")}, "methods"),
        ({"views": ("full+head",)}, "view"),
        ({"views": ("side",)}, "view"),
        ({"runs": 0}, "runs"),
        ({"frames": "3"}, "frames"),
        ({"frames": "0:3"}, "frames"),
        ({"frames": "147:"}, "frames"),
        ({"frames": "900:"}, "frames"),
        ({"sequences": ("nothing",)}, "sequence"),
        ({"settings": replace(SMALL, noise=2.0)}, "noise"),
        ({"settings": replace(SMALL, occlude=(5, 9))}, "occlude"),
    ],
)
def test_what_cannot_be_run_is_refused_by_its_name(how, field):
    with pytest.raises(InvalidArgument, match=field):
        replace(plan(), **how).check()


def test_frames_beyond_the_end_are_refused_where_they_were_asked_for():
    replace(plan(), frames="0:150").require_all_frames()
    with pytest.raises(InvalidArgument, match="frames: expected at most :150, the frames of sample, got '0:151'"):
        replace(plan(), frames="0:151").require_all_frames()


def test_a_virtual_camera_may_have_errors_and_what_is_no_camera_may_not():
    disturbed = replace(plan(views=("front", "ring4+body")), settings=replace(SMALL, depth_noise=0.001, fliers=0.1))
    disturbed.check()
    with pytest.raises(InvalidArgument, match="depth_noise"):
        replace(disturbed, views=("front", "full")).check()


def test_an_occlusion_that_some_frames_have_is_none_too_late():
    replace(plan(), settings=replace(SMALL, occlude=(4, 9))).check()


@pytest.mark.recordings
def test_what_a_real_camera_recorded_has_a_template_and_no_errors_of_a_virtual_one(tmp_path):
    for k in range(5):
        io.write_points(tmp_path / f"{k}.xyz", np.eye(3))
    of_a_folder = replace(plan(), sequences=(str(tmp_path),), views=("front",))
    with pytest.raises(InvalidArgument, match=r"template\.obj"):
        of_a_folder.check()
    recordings.find_recording.cache_clear()
    io.write_mesh(tmp_path / "template.obj", np.eye(3), np.array([[0, 1, 2]]))
    of_a_folder.check()
    assert (of_a_folder.unheeded(), plan().unheeded()) == ({"noise": None}, {})
    with pytest.raises(InvalidArgument, match="depth_noise"):
        replace(of_a_folder, settings=replace(SMALL, depth_noise=0.001)).check()


def _folder(path, unit):
    for k in range(5):
        io.write_points(path / f"{k}.xyz", unit * sample().garment_vertices[k])
    io.write_mesh(path / "template.obj", unit * sample().garment_vertices[0], sample().garment_faces)
    return str(path)


def test_a_folder_in_millimetres_is_refused(tmp_path):
    """Baselines took them for metres, and had errors of many metres."""
    with pytest.raises(InvalidMesh, match=r"garment: expected metres, .* got 624, which looks like millimetres"):
        replace(plan(), sequences=(_folder(tmp_path, 1000.0),)).check()


@pytest.mark.parametrize("view", ["front", "full,front"])
def test_views_of_what_a_real_sensor_saw_are_refused(capsys, tmp_path, view):
    """Rows of the same run were told as seen by one camera and from all around."""
    folder = _folder(tmp_path, 1.0)
    assert cli.main(["evaluate", folder, "--methods", "icp", "--view", view, "--json", str(tmp_path / "out.json")]) == 2
    assert f"view: expected none for recordings of real sensors, which saw what they saw, got {view}" in capsys.readouterr().err


def test_no_run_is_refused_and_not_taken_for_the_default(tmp_path, capsys):
    for more in (["--json", str(tmp_path / "out.json")], ["--paper", "--results", str(tmp_path / "results")]):
        assert cli.main(["evaluate", "sample", "--methods", "nicp", "--runs", "0", *more]) == 2
        assert "runs: expected at least 1" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.recordings
def test_what_is_over_before_its_occlusion_ends_has_none(tmp_path, monkeypatch):
    monkeypatch.delenv("DDAKF_DATA", raising=False)
    sample, short = recordings.find_recording("sample"), str(tmp_path / "short.npz")
    np.savez(short, garment_V=sample.garment_vertices[:20], garment_F=sample.garment_faces, fps=30)
    assert paper_studies.studies(paper_studies.QUICK, ["sample", short])["occlusion"].sequences == ("sample",)
    assert "occlusion" not in paper_studies.studies(paper_studies.QUICK, [short])


@pytest.mark.recordings
def test_a_file_that_is_no_sequence_is_refused_before_any_work(tmp_path, capsys):
    (tmp_path / "bad.npz").write_bytes(b"PK but no more")
    out = tmp_path / "out.json"
    assert cli.main(["evaluate", "sample", str(tmp_path / "bad.npz"), "--methods", "nicp", "--json", str(out)]) == 2
    said = capsys.readouterr().err
    assert "bad.npz" in said
    assert len(said.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == [tmp_path / "bad.npz"]


def test_a_row_says_what_a_system_lacks_and_the_others_have_their_results(systems, tmp_path):
    result = run_study(plan("broken", "absent", "frozen"), tmp_path / "out.json", 1, QUIET)
    broken, missing, frozen = result["results"]
    assert evaluate.reasons(result) == [
        "broken: LinAlgError: singular (sample full)",
        "absent: absent needs a package that is not installed (sample full)",
    ]
    assert (broken["failed"], broken["mean"], broken["runs"]) == ("LinAlgError: singular", None, [])
    assert (missing["not_applicable"], missing["mean"]) == ("absent needs a package that is not installed", None)
    assert frozen["mean"]["rmse_mm"] > 1
    assert frozen["mean"]["stretch_percent"] is not None
    assert json.loads((tmp_path / "out.json").read_text()) == json.loads(json.dumps(result))


def test_what_does_not_apply_is_null_and_not_zero(systems, tmp_path):
    cell = run_study(plan("frozen"), tmp_path / "out.json", 1, QUIET)["results"][0]
    assert cell["mean"]["coverage90"] is None
    assert cell["mean"]["reliability"] is None
    assert cell["sd"]["rmse_mm"] is None, "one run has no standard deviation"
    assert cell["mean"]["penetration_mm"] is not None


@pytest.mark.recordings
def test_a_view_with_a_body_does_not_apply_to_a_sequence_without(tmp_path, systems):
    sample = recordings.find_recording("sample")
    path = tmp_path / "bare.npz"
    np.savez(path, garment_V=sample.garment_vertices[:5], garment_F=sample.garment_faces, fps=30)
    chosen = replace(plan("frozen", views=("full", "full+body")), sequences=(str(path),))
    result = run_study(chosen, tmp_path / "o.json", 1, QUIET)
    assert [cell["mean"] is None for cell in result["results"]] == [False, True]
    assert "no body" in result["results"][1]["not_applicable"]


@pytest.mark.parametrize("options", [[], ["--no-surfaces"]])
def test_surfaces_are_measured_unless_told_otherwise(tmp_path, capsys, options):
    out = tmp_path / "out.json"
    command = ["evaluate", "sample", "--methods", "still", "--view", "full", "--runs", "1", "--frames", "0:6", "--procs", "1"]
    assert cli.main([*command, "--json", str(out), *options]) == 0
    result = json.loads(out.read_text())
    measured = [cell["mean"].get("hausdorff_mm") is not None for cell in result["results"]]
    assert (measured, result["meta"]["surfaces"]) == ([not options], not options)


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("options", "field"),
    [
        ("--methods ddakf,magic", "methods"),
        ("--only figure-1 --methods ddakf", "methods"),
        ("--only figure-9", "only"),
        ("--view front", "view"),
        ("--noise-mm 5", "noise_mm"),
        ("--json out.json", "json"),
    ],
)
def test_what_the_studies_of_the_paper_do_not_heed_is_refused(tmp_path, capsys, options, field):
    assert cli.main(["evaluate", "sample", "--paper", "--results", str(tmp_path / "results"), *options.split()]) == 2
    assert field in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.recordings
def test_the_studies_of_the_paper_can_be_of_some_systems(tmp_path):
    """Ablations alone have no DD-AKF of that name, and are left out."""
    command = ["evaluate", "sample", "--paper", "--quick", "--only", "main,ablation", "--methods", "icp-rigid", "--runs", "1"]
    assert cli.main([*command, "--frames", "0:5", "--procs", "1", "--results", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "main.json").read_text())
    assert {cell["method"] for cell in result["results"]} == {"icp-rigid"}
    assert not (tmp_path / "ablation.json").exists()

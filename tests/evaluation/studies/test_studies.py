"""Studies: bad plans are refused, interrupted ones resumed, and summaries follow rules checked by hand."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from ddakf.commands import cli, evaluate
from ddakf.errors import InvalidArgument, InvalidFile, NotApplicable
from ddakf.evaluation import machine
from ddakf.evaluation.studies import paper_studies, study_summary, worker_processes
from ddakf.evaluation.studies.execution import execute, run_study
from ddakf.evaluation.studies.row_log import RowLog
from ddakf.evaluation.studies.study_plan import StudyPlan
from ddakf.evaluation.trials import methods, recordings
from ddakf.evaluation.trials.trial import Trial
from ddakf.files import io

pytestmark = pytest.mark.slow

SMALL = Trial("", points=800, surfaces=True)
QUIET = Console(quiet=True)
TIMES = {"wall_ms_p50", "wall_ms_p99", "cpu_ms_p50", "cpu_ms_p99", "fps", "memory_mib", "processes"}


def plan(*systems: str, **how) -> StudyPlan:
    small = {"views": ("full",), "runs": 1, "frames": "0:5", "settings": SMALL}
    return StudyPlan(("sample",), systems or ("ddakf", "nicp"), **small | how)


class Broken:
    """Fails in its third frame."""

    def start(self, garment, vertices, body):
        self.vertices, self.left = vertices, 2

    def step(self, frame):
        self.left -= 1
        if self.left < 0:
            raise np.linalg.LinAlgError("singular")
        return self.vertices


class Frozen(Broken):
    """Stays where it was."""

    def step(self, frame):
        return self.vertices


def absent(scored):
    raise NotApplicable("absent needs a package that is not installed")


@pytest.fixture
def systems(monkeypatch):
    for name, factory in (("broken", lambda scored: Broken()), ("frozen", lambda scored: Frozen()), ("absent", absent)):
        monkeypatch.setitem(methods.BASELINES, name, factory)


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
        ({"systems": ("magic",)}, "variant"),
        ({"systems": ()}, "systems"),
        ({"systems": ("nicp", "nicp")}, "systems"),
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


def test_a_larger_study_runs_what_is_new_alone(systems, tmp_path):
    out, rows = tmp_path / "out.json", tmp_path / "out.rows.jsonl"
    first = run_study(plan("frozen"), out, 1, QUIET)
    before = rows.read_text()
    second = run_study(plan("frozen", "ddakf"), out, 1, QUIET)
    assert rows.read_text().startswith(before)
    assert rows.read_text().count("\n") == 2
    assert second["results"][0] == first["results"][0]


def test_a_system_that_failed_is_tried_again(systems, tmp_path, monkeypatch):
    out = tmp_path / "out.json"
    run_study(plan("broken"), out, 1, QUIET)
    monkeypatch.setitem(methods.BASELINES, "broken", lambda scored: Frozen())
    assert "failed" not in run_study(plan("broken"), out, 1, QUIET)["results"][0]


def test_a_line_that_was_cut_off_is_run_again_and_another_file_is_refused(systems, tmp_path):
    path, wanted = tmp_path / "j.rows.jsonl", plan("frozen", runs=2).trials()
    execute(wanted, RowLog(path), 1, QUIET)
    whole = path.read_text()
    path.write_text(whole[:-40])
    journal = RowLog(path)
    assert [journal.done(trial) for trial in wanted] == [True, False]
    execute(wanted, journal, 1, QUIET)
    assert [json.loads(line)["seed"] for line in path.read_text().splitlines()] == [1, 2]
    path.write_text("not rows\nat all\n")
    with pytest.raises(InvalidFile, match="line 1"):
        RowLog(path)


def test_a_line_without_its_end_is_written_anew_and_not_continued(systems, tmp_path):
    path, wanted = tmp_path / "j.rows.jsonl", plan("frozen", runs=2).trials()
    execute(wanted, RowLog(path), 1, QUIET)
    path.write_text(path.read_text()[:-1])
    execute(wanted, RowLog(path), 1, QUIET)
    assert [json.loads(line)["seed"] for line in path.read_text().splitlines()] == [1, 2]


@pytest.fixture
def code(monkeypatch):
    """What the code calls itself from now on."""
    return lambda name: monkeypatch.setattr(machine, "code_version", lambda: name)


def test_runs_of_older_code_are_kept_and_named_and_those_of_some_systems_run_again(systems, tmp_path, code):
    out, said = tmp_path / "out.json", Console(file=StringIO(), width=200)
    code("old")
    run_study(plan("frozen", "nicp"), out, 1, QUIET)
    code("new")
    kept = run_study(plan("frozen", "nicp"), out, 1, said)
    assert "2 of them are of other code than new (old: 2); --again frozen,nicp runs them again" in said.file.getvalue()
    assert kept["meta"]["commits"] == ["old"]
    changed = run_study(plan("frozen", "nicp"), out, 1, QUIET, again=["frozen"])
    assert [cell["runs"][0]["commit"] for cell in changed["results"]] == ["new", "old"]
    assert changed["meta"]["commits"] == ["new", "old"]
    before = (tmp_path / "out.rows.jsonl").read_bytes()
    run_study(plan("frozen", "nicp"), out, 1, QUIET, again=["frozen"])
    assert (tmp_path / "out.rows.jsonl").read_bytes() == before, "these are of this code already"


def test_uncommitted_code_is_not_known_to_be_the_same_and_what_did_not_apply_may_now(systems, tmp_path, code):
    out, rows = tmp_path / "out.json", tmp_path / "out.rows.jsonl"
    for name, lines in (("one-dirty", 2), ("one-dirty", 4)):
        code(name)
        run_study(plan("frozen", "absent"), out, 1, QUIET, again=["all"])
        assert rows.read_text().count("\n") == lines
    for again, lines in (([], 4), (["absent"], 5)):
        run_study(plan("frozen", "absent"), out, 1, QUIET, again=again)
        assert rows.read_text().count("\n") == lines


def test_a_system_to_be_run_again_is_one_of_the_study(tmp_path, capsys):
    command = ["evaluate", "sample", "--methods", "nicp", "--again", "icp", "--json", str(tmp_path / "out.json")]
    assert cli.main(command) == 2
    assert "again" in capsys.readouterr().err


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("options", "field"),
    [("--methods ddakf,magic", "methods"), ("--view front", "view"), ("--noise-mm 5", "noise_mm"), ("--json out.json", "json")],
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


def test_two_processes_give_the_rows_of_one(tmp_path):
    wanted = plan("nicp", runs=2).trials()
    one, two = RowLog(tmp_path / "1"), RowLog(tmp_path / "2")
    execute(wanted, one, 1, QUIET)
    execute(wanted, two, 2, QUIET)
    for a, b in zip(one.rows(wanted), two.rows(wanted), strict=True):
        assert {k: v for k, v in a.items() if k not in TIMES} == {k: v for k, v in b.items() if k not in TIMES}


class Started:
    """``ddakf evaluate`` in a process group of its own, as a terminal has it, when its first row is there."""

    def __init__(self, folder, procs: int, runs: int):
        self.out, self.rows = folder / "out.json", folder / "out.rows.jsonl"
        self.command = [sys.executable, "-m", "ddakf.commands.cli", "evaluate", "sample", "--methods", "nicp",
                        "--runs", str(runs),
                        "--frames", "0:8", "--points", "1500", "--procs", str(procs), "--json", str(self.out)]  # fmt: skip
        self.process = subprocess.Popen(
            self.command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # a shell's background jobs ignore it
        )  # fmt: skip
        while not (self.rows.is_file() and self.rows.read_text().count("\n")):
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.02)

    def all_ended(self) -> bool:
        """Within 20 seconds, the workers too."""
        for _ in range(200):
            try:
                os.killpg(self.process.pid, 0)
            except ProcessLookupError:
                return True
            time.sleep(0.1)
        return False

    def resumed(self) -> dict:
        before = self.rows.read_bytes()
        subprocess.run(self.command, check=True, capture_output=True, timeout=250)
        assert self.rows.read_bytes().startswith(before[: before.rindex(b"\n") + 1])
        return json.loads(self.out.read_text())["results"][0]


@pytest.mark.parametrize("procs", [1, 2])
def test_an_interrupted_study_goes_on_where_it_was(tmp_path, procs):
    started = Started(tmp_path, procs, 8)
    os.killpg(started.process.pid, signal.SIGINT)
    _, said = started.process.communicate(timeout=250)
    assert started.process.returncode == 130
    assert "of 8 runs are in" in said
    assert "Traceback" not in said
    assert started.all_ended()
    assert started.rows.read_text().count("\n") < 8
    assert len(started.resumed()["runs"]) == 8


def test_a_killed_study_leaves_no_process(tmp_path):
    started = Started(tmp_path, 2, 8)
    started.process.kill()
    started.process.communicate(timeout=250)
    assert started.all_ended()


def test_a_process_that_dies_costs_its_trial_alone(tmp_path):
    wanted, journal = plan("nicp", runs=3).trials(), RowLog(tmp_path / "j")
    rows = worker_processes.rows(wanted, 2)
    journal.add({"commit": "x"} | next(rows))
    multiprocessing.active_children()[-1].kill()
    for row in rows:
        journal.add({"commit": "x"} | row)
    failed = [row["failed"] for row in journal.rows() if "failed" in row]
    assert len(failed) == 1
    assert "status -9" in failed[0]
    assert len(journal.rows(wanted)) == 3


def row(system: str, seed: int, rmse: list[float], sequence: str = "a") -> dict:
    """A row whose clips have these errors."""
    clips = [{"first": 1 + 60 * k, "frames": 60, "rmse_mm": value} for k, value in enumerate(rmse)]
    frames = {"number": [1, 2, 3], "rmse_mm": [1.0, 2.0, 3.0], "reliability": [0.9, 0.8, 0.7], "penetration_mm": [0.0, 0.0, 0.0]}
    own = {"sequence": sequence, "view": "full", "body": False, "variant": system, "seed": seed, "occlude": None}
    return own | {"clips": clips, "rmse_mm": float(np.mean(rmse)), "per_frame": frames, "commit": "x"}


def test_mean_and_deviation_are_over_the_runs():
    cell = study_summary.summarise([row("ddakf", 1, [4.0]), row("ddakf", 2, [6.0])], {})["results"][0]
    assert (cell["mean"]["rmse_mm"], cell["sd"]["rmse_mm"]) == (5.0, pytest.approx(np.sqrt(2), rel=1e-5))
    assert cell["mean"]["iou"] is None
    assert cell["runs"][0]["spearman_reliability_rmse"] == -1
    assert cell["runs"][0]["spearman_reliability_penetration"] is None, "a constant has no ranks"


def test_the_unit_of_a_test_is_the_clip_and_the_seeds_are_averaged():
    ours = [row("ddakf", seed, [1.0 + 0.1 * seed, 2.0, 3.0]) for seed in (1, 2)]
    other = [row("icp", seed, [2.0, 3.0, 5.0 + seed]) for seed in (1, 2)]
    test = study_summary.summarise(ours + other, {})["p_values"]["all"]["rmse_mm"]["comparisons"]["icp"]
    assert test["n"] == 3
    assert test["p"] == 0.25, "of the eight ways to flip three signs, two are as extreme"
    assert test["p_smallest"] == 0.25
    assert test["verdict"] == "n too small"


def test_recovery_is_counted_from_the_end_of_the_occlusion_against_what_was_before():
    run = row("ddakf", 1, [1.0]) | {"occlude": [4, 6]}
    run["per_frame"] = {"number": list(range(1, 11)), "rmse_mm": [2.0, 2, 2, 9, 9, 8, 4, 3, 3, 2.5]}
    summed = study_summary.summarise([run], {})["results"][0]["runs"][0]
    assert summed["recovery_frames"] == 3
    assert summed["recovery_ratio"] == 2.05, "frames 6 to 10 over frames 1 to 3"
    run["per_frame"]["rmse_mm"][5:] = [9.0] * 5
    assert study_summary.summarise([run], {})["results"][0]["runs"][0]["recovery_frames"] is None


def test_without_ddakf_nothing_is_tested():
    assert study_summary.summarise([row("icp", 1, [1.0])], {})["p_values"] == {}

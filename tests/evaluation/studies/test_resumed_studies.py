"""Studies that were interrupted, cut off, or made larger go on where they were."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from io import StringIO

import pytest
from rich.console import Console

from ddakf import data
from ddakf.commands import cli
from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation import machine
from ddakf.evaluation.studies import worker_processes
from ddakf.evaluation.studies.execution import execute, run_study
from ddakf.evaluation.studies.row_log import RowLog
from ddakf.evaluation.trials import inputs, methods
from ddakf.evaluation.trials.recordings import find_recording
from ddakf.files import io
from tests.evaluation.studies.small import QUIET, SMALL, Broken, Frozen, plan

pytestmark = pytest.mark.slow

TIMES = {"wall_ms_p50", "wall_ms_p99", "cpu_ms_p50", "cpu_ms_p99", "fps", "memory_mib", "processes", "load_average", "seconds"}


def test_a_larger_study_runs_what_is_new_alone(systems, tmp_path):
    out, rows = tmp_path / "out.json", tmp_path / "out.rows.jsonl"
    first = run_study(plan("frozen"), out, 1, QUIET)
    before = rows.read_text()
    second = run_study(plan("frozen", "ddakf"), out, 1, QUIET)
    assert rows.read_text().startswith(before)
    assert rows.read_text().count("\n") == 2
    assert second["results"][0] == first["results"][0]


def test_a_trial_of_two_studies_runs_once(systems, tmp_path):
    noisy, plain = tmp_path / "noise-3.json", tmp_path / "untouched.json"
    first = run_study(plan("frozen", "broken"), plain, 1, QUIET)
    said = Console(file=StringIO(), width=200)
    second = run_study(plan("frozen", "nicp", "broken"), noisy, 1, said, others=[plain, noisy, tmp_path / "never-run.json"])
    assert "1 of 3 runs are taken over from untouched" in said.file.getvalue()
    assert second["results"][0] == first["results"][0]
    taken, *own = (tmp_path / "noise-3.rows.jsonl").read_text().splitlines()
    assert taken in (tmp_path / "untouched.rows.jsonl").read_text()
    assert len(own) == 2, "one that is new, and one that had failed"


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


def test_runs_that_are_made_again_keep_their_times_where_asked(systems, tmp_path, code):
    out = tmp_path / "out.json"
    code("old")
    run_study(plan("frozen"), out, 1, QUIET)
    result = json.loads(out.read_text())
    (first,) = result["results"][0]["runs"]
    out.write_text(json.dumps(result).replace(f'"ms_per_frame": {first["ms_per_frame"]}', '"ms_per_frame": 7000.0'))
    (tmp_path / "out.rows.jsonl").unlink()
    for name in ("new", "newer"):
        code(name)
        (cell,) = run_study(plan("frozen"), out, 1, QUIET, again=["frozen"], keep_times=True)["results"]
        (again,) = cell["runs"]
        assert (again["commit"], again["times_commit"], again["ms_per_frame"]) == (name, "old", 7000.0)
        assert again["rmse_mm"] == first["rmse_mm"]
        assert cell["mean"]["ms_per_frame"] == 7000.0
    code("newest")
    (cell,) = run_study(plan("frozen"), out, 1, QUIET, again=["frozen"])["results"]
    assert cell["runs"][0]["ms_per_frame"] < 7000.0
    assert "times_commit" not in cell["runs"][0]


def test_a_run_that_fails_does_not_lose_the_times_that_are_kept(systems, tmp_path, code, monkeypatch):
    out = tmp_path / "out.json"
    code("old")
    (first,) = run_study(plan("frozen"), out, 1, QUIET)["results"][0]["runs"]
    code("new")
    with monkeypatch.context() as patch:
        patch.setattr(Frozen, "step", Broken.step)
        (cell,) = run_study(plan("frozen"), out, 1, QUIET, again=["frozen"], keep_times=True)["results"]
        assert "singular" in cell["failed"]
    (again,) = run_study(plan("frozen"), out, 1, QUIET, again=["frozen"], keep_times=True)["results"][0]["runs"]
    assert (again["times_commit"], again["ms_per_frame"]) == ("old", first["ms_per_frame"])


def test_a_study_in_which_nothing_applies_is_repeated(systems, tmp_path):
    out = tmp_path / "out.json"
    first = run_study(plan("absent"), out, 1, QUIET)
    (tmp_path / "out.rows.jsonl").unlink()
    assert run_study(plan("absent"), out, 1, QUIET)["results"] == first["results"]


@pytest.mark.recordings
def test_a_recording_under_the_data_folder_that_was_replaced_is_run_again(systems, tmp_path, monkeypatch):
    monkeypatch.setenv("DDAKF_DATA", str(tmp_path))
    (tmp_path / "sequences").mkdir()
    first, second = sorted(data.TRAINING.glob("*.npz"))[:2]
    mine, short = tmp_path / "sequences/mine.npz", replace(plan("frozen"), sequences=("mine",))
    errors = []
    for source in (first, first, second):
        shutil.copy(source, mine)
        for cached in (find_recording, inputs._recording):
            cached.cache_clear()
        said = Console(file=StringIO(), width=200)
        errors.append(run_study(short, tmp_path / "out.json", 1, said)["results"][0]["mean"]["rmse_mm"])
    assert "1 runs are made again" in said.file.getvalue()
    assert errors[0] == errors[1] != errors[2]


def test_a_result_does_not_lie_in_a_recording(systems, tmp_path):
    io.write_mesh(tmp_path / "template.obj", data.sample().garment_vertices[0], data.sample().garment_faces)
    for number in range(5):
        io.write_points(tmp_path / f"{number}.xyz", data.sample().garment_vertices[number])
    with pytest.raises(InvalidArgument, match="json: expected a file outside of"):
        run_study(replace(plan("frozen"), sequences=(str(tmp_path),)), tmp_path / "out.json", 1, QUIET)


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


def test_two_processes_give_the_rows_of_one(tmp_path):
    wanted = plan("nicp", runs=2).trials()
    one, two = RowLog(tmp_path / "1"), RowLog(tmp_path / "2")
    execute(wanted, one, 1, QUIET)
    execute(wanted, two, 2, QUIET)
    for a, b in zip(one.rows(wanted), two.rows(wanted), strict=True):
        assert {k: v for k, v in a.items() if k not in TIMES} == {k: v for k, v in b.items() if k not in TIMES}


def test_a_study_goes_on_from_its_result_alone(tmp_path, systems, code):
    out, wanted = tmp_path / "out.json", ("frozen", "absent", "broken")
    code("old")
    first = run_study(plan(*wanted, runs=2, views=("full", "front+body")), out, 1, QUIET)
    (tmp_path / "out.rows.jsonl").unlink()
    code("new")
    second = run_study(plan(*wanted, "ddakf", runs=3, views=("full", "front+body")), out, 1, QUIET)
    before, after = ({(cell["view"], cell["method"]): cell for cell in result["results"]} for result in (first, second))
    for place, cell in before.items():
        assert after[place]["runs"][:2] == cell["runs"]
        assert after[place].get("not_applicable") == cell.get("not_applicable")
    assert [run["commit"] for run in after["full", "frozen"]["runs"]] == ["old", "old", "new"]
    assert [run["commit"] for run in after["full", "ddakf"]["runs"]] == ["new"] * 3
    again = run_study(plan(*wanted, "ddakf", runs=3, views=("full", "front+body")), out, 1, QUIET)
    assert again["results"] == second["results"]


def test_a_result_of_other_conditions_is_not_gone_on_with(tmp_path, systems, code):
    out = tmp_path / "out.json"
    code("old")
    run_study(plan("frozen"), out, 1, QUIET)
    for other in ({"frames": "0:6"}, {"settings": replace(SMALL, noise=0.001)}, {"settings": replace(SMALL, surfaces=False)}):
        (tmp_path / "out.rows.jsonl").unlink()
        code(str(other))
        assert run_study(plan("frozen", **other), out, 1, QUIET)["meta"]["commits"] == [str(other)]
    out.write_text('{"meta": 1}')
    with pytest.raises(InvalidFile, match="the result of a study"):
        run_study(plan("frozen"), out, 1, QUIET)


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


def test_words_in_brackets_are_no_markup(systems, tmp_path, monkeypatch):
    class Lost(Frozen):
        def step(self, frame):
            raise ValueError("cannot read [/home/me/x]")

    monkeypatch.setitem(methods.BASELINES, "broken", lambda scored: Lost())
    said = Console(file=StringIO(), width=200)
    result = run_study(plan("broken", "frozen"), tmp_path / "out.json", 1, said)
    assert "failed" in result["results"][0]
    assert "failed" not in result["results"][1]
    assert "ValueError: cannot read [/home/me/x]" in said.file.getvalue()


def test_a_log_is_written_by_one_run_at_a_time(tmp_path):
    first, second = (RowLog(tmp_path / "j") for _ in range(2))
    rows = [asdict(trial) | {"commit": "x"} for trial in plan("nicp", runs=3).trials()]
    first.add(rows[0])
    with pytest.raises(InvalidFile, match="one run at a time"):
        second.add(rows[1])
    first.add(rows[2])
    assert RowLog(tmp_path / "j").rows() == first.rows()


def test_the_log_of_another_study_is_only_read(tmp_path):
    row = asdict(plan("nicp").trials()[0]) | {"commit": "x"}
    assert RowLog(tmp_path / "j", [row], append=False).done(plan("nicp").trials()[0])
    assert not (tmp_path / "j").exists()


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

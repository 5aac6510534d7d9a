"""The benchmark is the held-out recordings, and a tracker from elsewhere runs on it."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ddakf.commands import cli
from ddakf.errors import InvalidArgument
from ddakf.evaluation import benchmark
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.simulation.collection_plan import SEEDS
from ddakf.evaluation.splits import is_untouched

OURS = benchmark.load()
LIGHTEST, OTHER = "tank_swing_close_10", "tank_run_close_32"


def test_the_benchmark_is_the_held_out_part_of_the_collection():
    listed = {each.name: (each.seed, each.sha256) for each in collection.listed(collection.HELD_OUT)}
    assert {each.name: (each.seed, each.sha256) for each in OURS.recordings} == listed
    assert all(each.seed in SEEDS[collection.HELD_OUT] and is_untouched(each.name) for each in OURS.recordings)
    assert len(OURS.recordings) >= 16
    assert OURS.title == "ddakf-simulated-1"
    with pytest.raises(InvalidArgument, match="version"):
        benchmark.load(7)


def test_a_copied_file_is_the_published_one_and_another_is_named(tmp_path, capsys):
    assert cli.main(["benchmark", "make", "--folder", str(tmp_path), "--only", LIGHTEST]) == 0
    assert "copied from the checkout, the published file" in capsys.readouterr().out
    assert len(benchmark.differing(OURS, tmp_path)) == len(OURS.recordings) - 1
    path = tmp_path / f"{LIGHTEST}.npz"
    path.write_bytes(path.read_bytes() + b"\0")
    assert any(line.startswith(f"{LIGHTEST}: SHA-256") for line in benchmark.differing(OURS, tmp_path))
    command = ["benchmark", "run", "--folder", str(tmp_path), "--only", LIGHTEST, "--json", str(tmp_path / "o.json")]
    assert cli.main(command) == 2
    assert "the recordings of ddakf-simulated-1" in capsys.readouterr().err


def test_unknown_recordings_and_systems_are_refused(tmp_path, capsys):
    out = ["--json", str(tmp_path / "o.json")]
    for words, said in (
        (["--only", "sample"], "recordings"),
        (["--submit", "nowhere:Nothing"], "MODULE:CLASS"),
        (["--submit", "json:JSONDecoder"], "without start"),
        (["--methods", "magic"], "methods"),
        (["--runs", "0"], "runs"),
    ):
        assert cli.main(["benchmark", "run", *words, *out]) == 2
        assert said in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_submitted_tracker_is_run_in_every_condition_and_stands_in_the_table(tmp_path, capsys, monkeypatch):
    (tmp_path / "mine.py").write_text(
        "class Still:\n"
        "    def start(self, garment, vertices, body): self.vertices, self.told = vertices, body is not None\n"
        "    def step(self, frame):\n"
        "        assert self.told == (frame.body_vertices is not None)\n"
        "        return self.vertices\n"
    )
    monkeypatch.chdir(tmp_path)
    short = benchmark.load().plan(["still"], collection.folder(), [LIGHTEST], 1)
    monkeypatch.setattr(benchmark.Benchmark, "plan", lambda self, systems, *rest: _short(short, systems))
    out = Path("out.json")
    assert cli.main(["benchmark", "run", "--methods", "still", "--submit", "mine:Still", "--procs", "1", "--json", str(out)]) == 0
    cells = json.loads(out.read_text())["results"]
    assert len(cells) == 2 * 3
    errors = {cell["method"]: [] for cell in cells}
    for cell in cells:
        errors[cell["method"]].append(cell["mean"]["rmse_mm"])
    assert errors["mine:Still"] == errors["still"]
    capsys.readouterr()
    assert cli.main(["benchmark", "table", str(out)]) == 0
    assert f"| mine:Still | **{errors['still'][0]:.1f}** |" in capsys.readouterr().out, "the best, as the other is a reference"


CENTRING = """
class Tracker:
    def start(self, garment, vertices, body): self.vertices = vertices
    def step(self, frame):
        frame.points[:] -= frame.points.mean(axis=0)
        if frame.body_vertices is not None:
            frame.body_vertices[:] += 1
        return self.vertices + SHIFT
"""


@pytest.mark.slow
def test_a_tracker_or_recording_that_has_changed_is_run_again(tmp_path, capsys, monkeypatch):
    """By a new process, as a module that was imported stays."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(collection.folder() / f"{LIGHTEST}.npz", "a.npz")

    def errors(shift: float) -> dict[str, float]:
        Path("changing.py").write_text(CENTRING.replace("SHIFT", str(shift)))
        options = "--methods still --submit changing:Tracker --runs 1 --frames 0:5 --no-surfaces --procs 1 --json out.json"
        code = f"import sys; from ddakf.commands import cli; sys.exit(cli.main('evaluate a.npz {options}'.split()))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        said.append(done.stderr)
        return {cell["method"]: cell["mean"]["rmse_mm"] for cell in json.loads(Path("out.json").read_text())["results"]}

    said: list[str] = []
    first = errors(0.0)
    assert first["changing:Tracker"] == first["still"], "what a tracker does to its input is its own affair"
    second = errors(1.0)
    assert second["changing:Tracker"] > 1000 > second["still"] == first["still"]
    assert "1 runs are made again, as the recording or the tracker is another: a.npz with changing:Tracker" in said[1]
    assert errors(1.0) == second
    assert "2 of 2 runs are in" in said[2]
    shutil.copy(collection.folder() / f"{OTHER}.npz", "a.npz")
    assert errors(1.0)["still"] != first["still"]
    capsys.readouterr()
    assert cli.main(["benchmark", "run", "--again", "other", "--json", "b.json"]) == 2
    assert "again: expected all, or some of ddakf, got other" in capsys.readouterr().err


def _short(plan, systems):
    from dataclasses import replace

    return replace(plan, systems=tuple(systems), frames="30:36")

"""The benchmark is the held-out recordings, and a tracker from elsewhere runs on it."""

import json
from pathlib import Path

import pytest

from ddakf.commands import cli
from ddakf.errors import InvalidArgument
from ddakf.evaluation import benchmark
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.simulation.collection_plan import SEEDS
from ddakf.evaluation.splits import is_untouched

OURS = benchmark.load()
LIGHTEST = "tank_swing_close_10"


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


def _short(plan, systems):
    from dataclasses import replace

    return replace(plan, systems=tuple(systems), frames="30:36")

"""Summaries of studies follow rules checked by hand, and their results can be traced."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from ddakf.errors import InvalidArgument
from ddakf.evaluation import machine
from ddakf.evaluation.studies import study_summary

pytestmark = pytest.mark.slow


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


def test_the_unit_of_a_test_is_the_sequence_and_seeds_and_clips_are_averaged():
    ours = [row("ddakf", seed, [1.0 + 0.1 * seed, 2.0], name) for seed in (1, 2) for name in "abc"]
    other = [row("icp", seed, [2.0, 3.0 + k + seed], name) for seed in (1, 2) for k, name in enumerate("abc")]
    test = study_summary.summarise(ours + other, {})["p_values"]["all"]["rmse_mm"]["comparisons"]["icp"]
    assert test["n"] == 3
    assert test["p"] == test["p_smallest"] == 0.25, "of the eight ways to flip three signs, two are as extreme"
    assert test["gain"] == pytest.approx(np.mean([3.25, 3.75, 4.25]) - 1.575)
    assert test["verdict"] == "n too small"


def test_a_system_whose_runs_failed_has_lost_them():
    ours = [row("ddakf", seed, [1.0], name) for seed in (1, 2, 3) for name in "ab"]
    other = [row("icp", 1, [2.0], name) for name in "ab"]
    told = {"sequence": "a", "view": "full", "body": False, "variant": "icp", "commit": "x", "failed": "LinAlgError: singular"}
    failed = [told | {"seed": seed, "sequence": name} for seed in (2, 3) for name in "ab"]
    result = study_summary.summarise(ours + other + failed, {})
    standing = result["p_values"]["all"]["rmse_mm"]["standing"]
    assert (standing["rivals"], standing["lost"]) == ([], ["icp"]), "two of three runs of either recording"
    assert [cell["failed_runs"] for cell in result["results"] if cell["method"] == "icp"] == [2, 2]
    kept = study_summary.summarise(ours + other, {})["p_values"]["all"]["rmse_mm"]["standing"]
    assert (kept["rivals"], kept["lost"]) == (["icp"], [])


def test_a_sequence_that_one_system_alone_has_is_counted_as_dropped():
    ours = [row("ddakf", 1, [1.0], name) for name in "abc"]
    other = [row("icp", 1, [2.0], name) for name in "ab"]
    test = study_summary.summarise(ours + other, {})["p_values"]["all"]["rmse_mm"]["comparisons"]["icp"]
    assert (test["n"], test["dropped"]) == (2, 1)


def test_clips_of_one_faust_subject_are_one_unit():
    names = [f"faust_s{subject}_p{pose}" for subject in (0, 1) for pose in (2, 3, 4)]
    rows = [row(system, 1, [error], name) for name in names for system, error in (("ddakf", 1.0), ("icp", 2.0))]
    assert study_summary.summarise(rows, {})["p_values"]["all"]["rmse_mm"]["comparisons"]["icp"]["n"] == 2


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


def committed(folder):
    """A repository with one commit of a source file, a result and a document."""
    for name in ("code.py", "results/a.json", "docs/a.md"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("1")
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", *words], cwd=folder, check=True)


def test_a_result_that_was_written_does_not_make_the_code_dirty(tmp_path):
    committed(tmp_path)
    clean = machine.revision_of(tmp_path)
    for name, dirty in (("results/a.json", False), ("docs/a.md", False), ("code.py", True)):
        (tmp_path / name).write_text("2")
        assert machine.revision_of(tmp_path) == clean + machine.DIRTY * dirty
    assert machine.revision_of(tmp_path / "..") is None


def test_results_of_uncommitted_code_are_refused_in_the_checkout_alone(tmp_path, monkeypatch):
    top = subprocess.run(["git", "rev-parse", "--show-toplevel"], capture_output=True, text=True, check=True).stdout.strip()
    monkeypatch.setattr(machine, "commit", lambda: "abc1234-dirty")
    ours = Path(top, "results/main.json")
    with pytest.raises(InvalidArgument, match="--allow-dirty"):
        machine.require_committed(ours, allowed=False)
    machine.require_committed(ours, allowed=True)
    machine.require_committed(tmp_path / "main.json", allowed=False)
    monkeypatch.setattr(machine, "commit", lambda: "abc1234")
    machine.require_committed(ours, allowed=False)


def test_a_commit_that_the_history_does_not_have_is_not_traceable():
    head = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    assert machine.is_traceable(head)
    assert not machine.is_traceable(f"{head}-dirty")
    assert not machine.is_traceable("0123456789")
    assert machine.is_traceable("version 0.1.0")

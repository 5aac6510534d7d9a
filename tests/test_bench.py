"""The benchmark runs and writes what it says; no test looks at a time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
STAGES = {"input", "predict", "preprocess", "coarse", "associate", "robust", "adapt", "physics", "fuse"}
STAGES |= {"uncertainty", "reliability", "output", "total"}


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, ROOT / "benchmarks/bench.py", "--quick", "--out", folder, "--name", "quick"]
    environment = {name: value for name, value in os.environ.items() if name != "DDAKF_DATA"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "one frame" in ended.stdout
    return json.loads((folder / "quick.json").read_text())


def test_the_machine_is_named(report):
    machine = report["machine"]
    assert machine["cpu"]
    assert machine["cores"] >= 1
    assert machine["python"]
    assert {"numpy", "numba"} <= set(machine["packages"])
    assert report["size"] == "quick"


def test_every_stage_has_a_time_and_the_run_its_errors(report):
    assert [row["name"] for row in report["frame"]] == ["sample, full", "sample, front + body"]
    for row in report["frame"]:
        assert set(row["ms"]) == STAGES
        assert all(set(times) == {"p50", "p99"} for times in row["ms"].values())
        assert 0 < row["normal_rmse_mm"] <= row["rmse_mm"]
        assert 0 <= row["coverage90"] <= 1


def test_every_change_is_switched_off_in_turn(report):
    names = [row["config"][:2] for row in report["changes"]]
    assert names == 2 * ["de", "1.", "2.", "3.", "4.", "5.", "Co"]
    assert [row["config"] for row in report["changes"] if not row.get("rmse_mm", 0) > 0] == []


def test_open3d_is_compared_or_a_sentence_says_why_not(report):
    part = report["open3d"]
    assert "skipped" in part or all(part["rows"][0][key] > 0 for key in ("open3d_over_ddakf", "rmse_mm", "normal_rmse_mm"))


def test_the_non_rigid_icp_runs_beside_the_tracker(report):
    first, *others = report["icp"]
    assert (first["method"], first["over_default"]) == ("default", 1.0)
    assert len(others) > 0
    for row in report["icp"]:
        assert row["ms"]["p50"] > 0
        assert row["over_default"] == pytest.approx(row["ms"]["p50"] / first["ms"]["p50"], rel=0.05, abs=0.01)
        beside = row["over_open3d_preprocessing"]
        assert beside is None if "skipped" in report["open3d"] else beside > 0
        assert 0 < row["rmse_mm"] < 100


def test_scaling_has_an_exponent_and_garments_of_the_sizes_asked_for(report):
    part = report["scaling"]
    assert isinstance(part["exponent"], float)
    assert len(part["rows"]) == len(part["steps"]) + 1
    assert [(row["vertices"], row["points"]) for row in part["rows"]] == [(400, 2_000), (800, 4_000)]


def test_memory_of_a_frame_and_a_cold_start(report):
    assert report["memory"]["peak_mib_per_frame"]["p50"] > 0
    cold = report["cold"]
    assert cold["together_s"] == pytest.approx(cold["import_s"] + cold["first_frame_s"], abs=2e-3)
    assert cold["peak_mib"] > 0


def test_filters_memory_codecs_and_service(report):
    assert {row["filter"] for row in report["outliers"]["rows"]} >= {"ddakf, grid (default)", "ddakf, k-NN (paper)"}
    assert [mark["frame"] for mark in report["growth"]["marks"]] == [1, 4]
    assert {row["codec"] for row in report["codecs"]} == {"raw", "quantised", "morton-zstd", "morton-deflate", "draco"}
    assert all(row["largest_error_mm"] < 0.26 for row in report["codecs"]), "half of the default step"
    assert {row["codec"].partition(",")[0] for row in report["images"]} == {"none", "zstd", "png", "rvl"}
    assert all(row["largest_error_mm"] < 0.51 for row in report["images"]), "half a millimetre, of whole ones"
    assert all(row["frames"] == 3 for row in report["service"]["overhead"])
    load = report["service"]["clients"]
    assert load["frames_sent"] == load["frames_answered"] + load["frames_dropped"]

"""Load, soak, chaos and kill, short: that they run, find what they shall, and can find something. Nothing is said about speed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


def run(script: str, out: Path, *arguments: str) -> tuple[dict, int]:
    """The part of the result file, and the exit status."""
    command = [sys.executable, ROOT / f"benchmarks/{script}.py", "--out", out, *arguments]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("DDAKF_")}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode in (0, 1), ended.stderr
    return json.loads(out.read_text())[script], ended.returncode


def test_load_is_counted(tmp_path):
    size = ("--vertices", "400", "--points", "1000")
    arguments = ("--clients", "2", "--seconds", "2", "--rate", "10", "--flow", "lossless", *size)
    (part,), status = run("load", tmp_path / "load.json", *arguments)
    assert status == 0
    assert part["sent"] == part["answered"] == 40
    assert part["dropped"] == 0
    assert part["refused"] == {}
    assert 0 < part["latency_ms"]["p50"] <= part["latency_ms"]["p99"] <= part["latency_ms"]["p99.9"]
    assert part["cores"] > 0
    assert part["rmse_mm"] > 0


def test_nothing_is_left_of_clients_that_come_and_leave(tmp_path):
    arguments = ("--seconds", "10", "--cycles", "24", "--clients", "1", "--rate", "5", "--vertices", "400", "--points", "1000")
    part, _ = run("soak", tmp_path / "soak.json", *arguments)
    assert part["cycles"] == 24
    assert part["errors"] == {}
    assert part["sessions_left"] == 0
    assert not [sentence for sentence in part["failed"] if "descriptors" in sentence]
    # ten seconds say nothing about growth: a worker's memory has not settled by then


def test_sessions_outlive_what_goes_wrong(tmp_path):
    arguments = ("--seconds", "32", "--clients", "1", "--frames", "20", "--rate", "5", "--points", "1000", "--workers", "1")
    part, status = run("chaos", tmp_path / "chaos.json", *arguments, "--hostile-seconds", "1")
    assert part["troubles"], "nothing went wrong"
    assert part["hostile"]["answers"].keys() <= {"result", "FrameTooCostly"}
    assert len(part["hostile"]["longest_gap_ms"]) == 1
    assert [sentence for sentence in part["failed"] if "waited for" not in sentence] == []
    assert status == int(bool(part["failed"]))


def test_a_session_goes_on_after_each_kill_of_its_worker(tmp_path):
    size = ("--vertices", "400", "--points", "1000", "--rate", "5")
    part, status = run("kill", tmp_path / "kill.json", "--kills", "2", "--restarts", "1", *size)
    (row,) = part["rows"]
    assert row["kills"] == len(row["stood_s"]) == len(row["frames_forgotten"]) == 2
    assert row["ended"] == ""
    assert len(part["restart"]["stood_s"]) == 1
    assert part["restart"]["answers_missing"] == 0
    assert status == int(part["failed"] != [])

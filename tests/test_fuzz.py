"""A short run of what ``make fuzz`` does, in this process; and that it would find what there is to find."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import fuzz
import fuzz_targets
import hypothesis
import pytest
from hypothesis import strategies as st

ROOT = Path(__file__).parents[1]
TARGETS = fuzz_targets.all_targets()


@pytest.mark.parametrize("name", TARGETS)
def test_valid_input_is_answered(name):
    target = TARGETS[name]()
    accepted = [seed for seed in target.seeds if not _refused(target, seed)]
    assert len(accepted) >= len(target.seeds) - 1  # a stream's start is no frame


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_is_answered_or_refused(name):
    target = TARGETS[name]()

    @hypothesis.seed(1)
    @hypothesis.settings(max_examples=60, database=None, deadline=None, suppress_health_check=list(hypothesis.HealthCheck))
    @hypothesis.given(seed=st.sampled_from(target.seeds), changes=fuzz.changes(), other=st.sampled_from(target.seeds))
    def run(seed, changes, other):
        _refused(target, fuzz.mutated(seed, changes, other))

    run()


def _refused(target, data: bytes) -> bool:
    try:
        target.run(data)
    except fuzz_targets.REFUSALS:
        return True
    return False


@pytest.mark.slow
def test_every_target_has_a_process_that_counts_its_answers(tmp_path):
    options = ["--inputs", "100", "--only", "packed array", "--out", str(tmp_path)]
    command = [sys.executable, str(ROOT / "benchmarks/fuzz.py"), *options]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    rows = [json.loads(line) for line in ended.stderr.splitlines() if line.startswith("{")]
    assert {row["engine"] for row in rows} >= {"hypothesis"}
    assert all(row["accepted"] + row["refused"] == row["inputs"] > 30 for row in rows)
    assert all(row["accepted"] > 0 < row["refused"] for row in rows)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("raise ZeroDivisionError('here')", "ZeroDivisionError: here"),
        ("bytes(1 << 40)", "MemoryError"),
        ("import time; time.sleep(0)\nwhile True: pass", "0.2 s of CPU time"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV"),
    ],
    ids=["an exception", "memory", "a hang", "a dead process"],
)
def test_what_a_target_must_not_do_is_found(tmp_path, monkeypatch, body, said):
    program = tmp_path / "planted.py"
    program.write_text(
        f"import resource, sys\nsys.path.insert(0, {str(ROOT / 'benchmarks')!r})\nimport fuzz\nfuzz.SECONDS = 0.2\n"
        "from pathlib import Path\n"
        "def run(data):\n" + "".join(f"    {line}\n" for line in body.splitlines()) + "class Target: pass\n"
        "target = Target(); target.run = run\nresource.setrlimit(resource.RLIMIT_AS, (1 << 34, 1 << 34))\n"
        "fuzz.Trial(target, (ValueError,), Path(sys.argv[1]))(b'input')\n"
    )
    monkeypatch.setattr(fuzz, "SECONDS", 0.2)
    current, log = tmp_path / "planted.input", tmp_path / "planted.log"
    with log.open("w") as errors:
        ended = subprocess.run([sys.executable, str(program), str(current)], stderr=errors, check=False, timeout=250)
    assert ended.returncode != 0
    assert said in fuzz._why(ended.returncode, log)
    assert current.read_bytes() == b"input"


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "findings"), [(0.0, 2), (1e9, 0)])
def test_sessions_that_cost_more_than_the_limit_are_found(limit, findings):
    program = (
        f"import sys; sys.path.insert(0, {str(ROOT / 'benchmarks')!r})\n"
        f"import cost, fuzz\ncost.LIMIT, fuzz.COST_SIZES = {limit}, (('400:1000', 'full'),)\n"
        "sys.exit(fuzz.main(['--only', 'cost', '--scenes', '2']))"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == int(findings > 0), ended.stderr
    assert f"2 sessions of adversarial frames, {findings} findings" in ended.stdout
    assert ended.stdout.count("times a spread cloud") == findings

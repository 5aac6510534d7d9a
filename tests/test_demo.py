"""``ddakf demo``: from nothing to a table and pictures, and nothing left behind."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

# a job in the background of a shell ignores SIGINT, and so would its children
LISTENING = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"
DEMO = [sys.executable, "-c", "import sys; from ddakf.commands.cli import main; sys.exit(main())", "demo"]


def processes_of(log: Path) -> list[int]:
    """Processes that hold this log open: the service of a demo, and its workers."""
    found = []
    for descriptor in Path("/proc").glob("[0-9]*/fd/2"):
        try:
            if os.readlink(descriptor) == str(log):
                found.append(int(descriptor.parts[2]))
        except OSError:
            continue  # it has ended meanwhile
    return found


def test_a_demo_ends_with_a_table_and_pictures(tmp_path):
    command = [*DEMO, "--frames", "24", "--out", str(tmp_path), "--json"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert ended.returncode == 0, ended.stderr
    figures = json.loads(ended.stdout)
    assert figures["frames"] == 24
    assert figures["RMSE against the truth (mm)"] < 40, "closer than the start, even where frames are dropped"
    assert 0 <= figures["truth inside the 90 % ellipsoids (%)"] <= 100
    assert (tmp_path / "frame.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "animation.gif").read_bytes().startswith(b"GIF8")
    assert processes_of(tmp_path / "service.log") == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_demo_leaves_no_process(tmp_path, number):
    log = tmp_path / "service.log"
    command = [sys.executable, "-c", LISTENING, *DEMO, "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as demo:
        deadline = time.monotonic() + 60
        while len(processes_of(log)) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(processes_of(log)) >= 2
        demo.send_signal(number)
        assert demo.wait(60) == 128 + number
        demo.stderr.read()
    deadline = time.monotonic() + 20  # the kernel kills the template when the service has ended
    while processes_of(log) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert processes_of(log) == []


def test_a_kept_service_goes_on(tmp_path):
    command = [*DEMO, "--frames", "6", "--out", str(tmp_path), "--keep"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert ended.returncode == 0, ended.stderr
    pid = int(re.search(r"kill (\d+) stops it", ended.stdout)[1])
    try:
        assert re.search(r"gRPC 127\.0\.0\.1:\d+, REST http://127\.0\.0\.1:\d+", ended.stdout)
        assert pid in processes_of(tmp_path / "service.log")
    finally:
        os.kill(pid, signal.SIGTERM)
    deadline = time.monotonic() + 20
    while processes_of(tmp_path / "service.log") and time.monotonic() < deadline:
        time.sleep(0.05)
    assert processes_of(tmp_path / "service.log") == []

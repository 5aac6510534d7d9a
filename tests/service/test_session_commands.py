"""``ddakf sessions`` against a running service."""

from __future__ import annotations

import itertools
import json
import signal
import subprocess
import sys
import time

import httpx
import pytest
from ddakf_api.errors import SessionNotFound

from ddakf.commands import cli
from ddakf.commands.remote.sessions import _text

from .conftest import TIMEOUT, eventually, frame_of, request_of

# a job in the background of a shell ignores SIGINT, and so would its children
START = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); from ddakf.commands.cli import main"
PROGRAM = [sys.executable, "-c", f"{START}; sys.exit(main())"]
COMMAND = [*PROGRAM, "sessions"]


@pytest.fixture
def sessions(service, capsys):
    """Runs the command and returns its output."""

    def run(*arguments: str, status: int = 0) -> str:
        assert cli.main(["sessions", *arguments, "--server", service.grpc]) == status
        output = capsys.readouterr()
        return output.out if status == 0 else output.err

    return run


def test_sessions_are_listed_shown_and_deleted(sessions, api, sheet):
    first, second = (api.create(sheet, labels={"take": take}).name.removeprefix("sessions/") for take in ("one", "two"))
    list(api.track(f"sessions/{first}", [request_of(frame_of(sheet, i)) for i in (1, 2)]))
    rows = json.loads(sessions("list", "--label", "take=one", "--json"))
    assert [(row["session_id"], row["applied"], row["state"]) for row in rows] == [(first, 2, "idle")]
    assert {first, second} <= set(sessions("list", "--state", "idle").split())
    shown = json.loads(sessions("--json", "get", first))
    assert shown.keys() - rows[0].keys() == {"config"}
    assert {name: shown[name] for name in ("applied", "labels")} == {name: rows[0][name] for name in ("applied", "labels")}
    shown = sessions("get", first)
    assert {"labels", "take=one", "n_vertices", "max_points=500000"} <= set(shown.split())
    assert "{" not in shown
    assert sessions("list", "--label", "take=none") == "no session matches\n"
    assert sessions("delete", first, second) == ""
    for name in (first, second):
        with pytest.raises(SessionNotFound):
            api.get(f"sessions/{name}")


def test_sessions_are_deleted_though_some_are_not_there(sessions, api, sheet, capsys):
    first, second = (api.create(sheet).name.removeprefix("sessions/") for _ in range(2))
    assert sessions("delete", first, "nobody", second, "nor-this", status=2).splitlines() == [
        "ddakf: there is no session 'sessions/nobody'", "ddakf: there is no session 'sessions/nor-this'",
    ]  # fmt: skip
    for name in (first, second):
        with pytest.raises(SessionNotFound):
            api.get(f"sessions/{name}")


def test_the_history_has_the_frames_of_an_ended_session(sessions, api, sheet):
    name = api.create(sheet).name
    list(api.track(name, [request_of(frame_of(sheet, i)) for i in (1, 2, 3)]))
    api.delete(name)
    session_id = name.removeprefix("sessions/")
    history = json.loads(sessions("history", session_id, "--json"))
    assert sum(history["applied"]) == 3
    assert history["states"][-1]["state"] == "closed"
    long_ago = ("--start", "2019-01-01", "--end", "2020-01-01T00:00:00", "--json")
    assert json.loads(sessions("history", session_id, *long_ago))["applied"] == []
    since = "--start", str(time.time() - 3600), "--json"
    assert sum(json.loads(sessions("history", session_id, *since))["applied"]) == 3
    table = sessions("history", session_id)
    assert "reliability" in table
    assert table.splitlines()[-1].endswith("closed")


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_a_watcher_prints_results_until_it_is_interrupted(service, api, session, sheet, form):
    command = [*COMMAND, "watch", session, "--server", service.grpc, *form]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as watcher:
        try:
            eventually(lambda: watcher.poll() is not None or watching(service))
            list(api.track(session, [request_of(frame_of(sheet, 1))]))
            line = watcher.stdout.readline()
            watcher.send_signal(signal.SIGINT)
            _, errors = watcher.communicate(timeout=TIMEOUT)
        finally:
            watcher.kill()
    assert (watcher.returncode, errors) == (0, "")
    if form:
        result = json.loads(line)
        assert (result["sequence"], result["state"]) == (1, "tracking")
        assert result["timings"]["server"] > 0
    else:
        assert line.startswith("frame      1  tracking")


def watching(service) -> bool:
    """Whether the service has a watcher."""
    lines = httpx.get(service.http + "/metrics", timeout=TIMEOUT).text.splitlines()
    return any(line.startswith("ddakf_watchers ") and float(line.split()[1]) > 0 for line in lines)


@pytest.mark.parametrize("address", ["nonsense", "127.0.0.1:99999", "127.0.0.1:", ":7701", "http://127.0.0.1:7702"])
def test_an_address_without_a_port_is_refused(capsys, address):
    assert cli.main(["sessions", "list", "--server", address]) == 2
    assert capsys.readouterr().err == f"ddakf: server: expected HOST:PORT of gRPC, got {address}\n"


def test_errors_are_one_sentence(sessions, service, capsys):
    assert sessions("get", "nobody", status=2) == "ddakf: there is no session 'sessions/nobody'\n"
    assert "state: expected initializing or tracking" in sessions("list", "--state", "happy", status=2)
    assert "label: expected KEY=VALUE, got take" in sessions("list", "--label", "take", status=2)
    assert "start: expected a time" in sessions("history", "nobody", "--start", "soon", status=2)
    assert cli.main(["sessions", "list", "--server", service.grpc, "--api-key", "nonsense"]) == 2
    assert capsys.readouterr().err.startswith("ddakf: the key is not known")


@pytest.mark.parametrize("program", [PROGRAM, COMMAND], ids=["record", "sessions record"])
def test_a_recorded_session_is_replayed_to_the_bit(sessions, service, api, session, sheet, tmp_path, capsys, program):
    session_id, path = session.removeprefix("sessions/"), str(tmp_path / "some.mcap")
    list(api.track(session, [request_of(frame_of(sheet, 1))]))
    command = [*program, "record", session_id, path, "--frames", "3", "--json", "--server", service.grpc]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as recorder:
        try:
            eventually(lambda: recorder.poll() is not None or (tmp_path / "some.mcap").exists())
            for number in itertools.count(2):  # the recorder may miss the first ones
                list(api.track(session, [request_of(frame_of(sheet, number))]))
                if recorder.poll() is not None:
                    break
            output, errors = recorder.communicate(timeout=TIMEOUT)
        finally:
            recorder.kill()
    assert (recorder.returncode, errors) == (0, "")
    assert json.loads(output) == {"file": path, "frames": 3, "missing": 0}
    replayed = {"frames": 3, "same_state": 3, "largest_difference_mm": 0.0}
    replayed |= {"short_of_time": 0, "missing": 0, "frames_before": 3, "largest_difference_before_mm": 0.0}
    assert json.loads(sessions("replay", path, "--json")) == replayed
    assert cli.main(["replay", path, "--server", service.grpc]) == 0
    assert "largest difference" in capsys.readouterr().out


def test_a_file_that_is_no_recording_is_refused(sessions, tmp_path):
    assert "expected a recording, got" in sessions("replay", str(tmp_path / "none.mcap"), status=2)
    (tmp_path / "text.mcap").write_text("some text that is no recording")
    assert "expected an MCAP file" in sessions("replay", str(tmp_path / "text.mcap"), status=2)


def test_numbers_are_short_and_clocks_keep_their_milliseconds():
    values = {"rate": 29.97002997002997, "last_timestamp": 1796123456.25, "frames": 1234567, "key": None}
    assert _text(values) == "frames=1234567 key= last_timestamp=1796123456.250 rate=29.97"

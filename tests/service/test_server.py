"""Server: start, failing workers, drain, end; with real processes and signals."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys

import httpx
import pytest
from ddakf_api.errors import Draining
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.build import build
from ddakf_service.commands.serve import JsonAnnouncer
from ddakf_service.commands.service_process import ServiceFailed, ServiceProcess
from ddakf_service.observability.metrics import Metrics
from ddakf_service.server import Server
from ddakf_service.settings import Settings
from ddakf_service.store.store import Store

import ddakf

from .conftest import TIMEOUT, Api, Talk, children, eventually, fork_server, frame_of, held, is_running

pytestmark = pytest.mark.slow


def serve(*arguments: str, **options) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "ddakf_service", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=250, check=False, **options)


@pytest.fixture
def own_service(tmp_path):
    """A service that the test may end."""
    arguments = ["--workers", "1", "--spare-workers", "0", "--drain-grace", "3"]
    process = ServiceProcess(arguments, log=tmp_path / "service.log")
    process.wait_until_ready()
    yield process
    process.stop()


def test_print_config_shows_values_and_origins(tmp_path):
    file = tmp_path / "ddakf.toml"
    file.write_text("max_points = 1000\n")
    environment = {**os.environ, "DDAKF_HOST": "127.0.0.9"}
    arguments = ["--print-config", "--json", "--config", str(file), "--workers", "3"]
    shown = json.loads(serve(*arguments, env=environment).stdout)
    assert shown["workers"] == {"value": 3, "from": "flag --workers"}
    assert shown["host"] == {"value": "127.0.0.9", "from": "environment DDAKF_HOST"}
    assert shown["max_points"] == {"value": 1000, "from": f"file {file}"}
    assert shown["log_level"] == {"value": "info", "from": "default"}
    table = serve("--print-config")
    assert table.returncode == 0
    assert "max_message_bytes" in table.stdout


def test_a_bad_setting_ends_with_status_two():
    ended = serve("--workers", "0")
    assert ended.returncode == 2
    assert ended.stderr.strip() == "ddakf serve: workers: expected greater than or equal to 1, got '0' from flag --workers"


@pytest.mark.parametrize("flag", ["--grpc-port", "--http-port"])
def test_a_port_in_use_ends_with_status_two(flag):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        ports = {"--grpc-port": "0", "--http-port": "0", flag: port}
        ended = serve(*(word for pair in ports.items() for word in pair))
    assert ended.returncode == 2
    assert flag.removeprefix("--").replace("-", "_") in ended.stderr
    assert port in ended.stderr


def test_before_the_workers_are_warm_nothing_is_ready(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "ddakf_service", "--http-port", str(port), "--grpc-port", "0", "--workers", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:

            def status(path: str) -> int:
                try:
                    return httpx.get(f"http://127.0.0.1:{port}{path}", timeout=5).status_code
                except httpx.TransportError:
                    return 0

            with held([eventually(lambda: fork_server(process.pid))]):
                eventually(lambda: status("/healthz") == 200)
                assert status("/readyz") == 503
            eventually(lambda: status("/readyz") == 200, 120)
        finally:
            process.terminate()
        assert process.wait(TIMEOUT) == 0
        assert "is ready" in process.stdout.read()


def test_a_drain_tells_its_clients_and_ends_with_status_zero(own_service, sheet):
    api = Api(own_service.grpc)
    talk = Talk(api, api.create(sheet).name)
    assert talk.ask(frame_of(sheet, 1))[-1].result.sequence_number == 1
    workers = children(own_service.pid)
    os.kill(own_service.pid, signal.SIGTERM)
    notice = next(talk.answers).notice
    assert notice.kind == pb.NOTICE_KIND_DRAINING
    assert notice.value == 3
    assert httpx.get(own_service.http + "/readyz").status_code == 503
    with pytest.raises(Draining):
        api.create(sheet)
    assert talk.ask(frame_of(sheet, 2))[-1].result.sequence_number == 2, "frames are answered while the clients leave"
    talk.end()
    assert own_service.wait() == 0
    assert not any(is_running(pid) for pid in workers)
    api.channel.close()


def test_a_drain_names_the_server_that_takes_over(tmp_path, sheet):
    arguments = ["--workers", "1", "--spare-workers", "0", "--drain-grace", "0.2", "--successor", "elsewhere.example:7701"]
    process = ServiceProcess(arguments, log=tmp_path / "service.log")
    process.wait_until_ready()
    api = Api(process.grpc)
    with Talk(api, api.create(sheet).name) as talk:
        os.kill(process.pid, signal.SIGTERM)
        notices = [next(talk.answers).notice for _ in range(2)]
        with pytest.raises(Draining):
            next(talk.answers)
    assert process.wait() == 0
    api.channel.close()
    assert (notices[1].kind, notices[1].target) == (pb.NOTICE_KIND_RECONNECT, "elsewhere.example:7701")


def test_a_log_for_programs_holds_nothing_else(tmp_path):
    command = [sys.executable, "-m", "ddakf_service", "--workers", "1", "--spare-workers", "0", "--grpc-port", "0",
               "--http-port", "0", "--data-dir", "none", "--log-format", "json"]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        lines = []
        for line in process.stderr:
            lines.append(json.loads(line))
            if lines[-1]["message"] == "ready":
                break
        process.terminate()
        rest, said = process.stderr.read(), process.stdout.read()
    assert process.returncode == 0
    assert said == ""
    lines += map(json.loads, rest.splitlines())
    (ready,) = (line for line in lines if line["message"] == "ready")
    assert httpx.URL(ready["http"]).port
    assert (ready["version"], ready["build"]) == (ddakf.__version__, build())


@pytest.fixture
def hangup():
    """The signal as it is in a terminal; tests under nohup would hand it on as ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def test_the_end_of_its_terminal_stops_a_service_in_order(hangup, own_service, sheet):
    """The system sends the signal to every process of the service, and the shell again."""
    api = Api(own_service.grpc)
    talk = Talk(api, api.create(sheet).name)
    for pid in (*children(own_service.pid), own_service.pid):
        os.kill(pid, signal.SIGHUP)
    assert next(talk.answers).notice.kind == pb.NOTICE_KIND_DRAINING
    os.kill(own_service.pid, signal.SIGHUP)
    assert talk.ask(frame_of(sheet, 1))[-1].result.sequence_number == 1, "frames are answered while the clients leave"
    talk.end()
    assert own_service.wait() == 0
    api.channel.close()


async def test_who_is_started_by_nohup_outlives_its_terminal(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        server = Server(Settings(workers=1, spare_workers=0, grpc_port=0, http_port=0, data_dir=str(tmp_path)))
        server.stop()
        await server.run(lambda *_: None, lambda _: None)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_clients_that_stay_are_cut_off_after_the_grace(own_service, sheet):
    api = Api(own_service.grpc)
    with Talk(api, api.create(sheet).name) as talk:
        os.kill(own_service.pid, signal.SIGTERM)
        notices = [next(talk.answers).notice.kind for _ in range(2)]
        assert notices == [pb.NOTICE_KIND_DRAINING, pb.NOTICE_KIND_RECONNECT]
        with pytest.raises(Draining):
            next(talk.answers)
    assert own_service.wait() == 0
    api.channel.close()


def test_a_second_signal_forces_the_end(own_service, sheet):
    api = Api(own_service.grpc)
    with Talk(api, api.create(sheet).name) as talk:
        workers = children(own_service.pid)
        os.kill(own_service.pid, signal.SIGINT)
        assert next(talk.answers).notice.kind == pb.NOTICE_KIND_DRAINING
        assert own_service.stop(signal.SIGINT) == 1, "a drain ends with 0"
    eventually(lambda: not any(is_running(pid) for pid in workers))
    api.channel.close()


def test_a_killed_server_leaves_no_worker(own_service):
    processes = children(own_service.pid)
    assert len(processes) == 2, "a worker and its fork server"
    assert own_service.stop(signal.SIGKILL) == -signal.SIGKILL
    eventually(lambda: not any(is_running(pid) for pid in processes))


def test_a_service_of_a_killed_parent_ends(tmp_path):
    script = (
        "import os, pathlib, sys; from ddakf_service.commands.service_process import ServiceProcess\n"
        "service = ServiceProcess(['--workers', '1'], log=pathlib.Path(sys.argv[1]))\n"
        "service.wait_until_ready(); print(service.pid, flush=True); os.kill(os.getpid(), 9)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "log")],
        stdout=subprocess.PIPE,
        text=True,
        timeout=120,
        check=False,
    )
    pid = int(ended.stdout)
    eventually(lambda: not is_running(pid))


def test_a_service_that_cannot_start_says_why(tmp_path):
    service = ServiceProcess(["--workers", "none"], log=tmp_path / "service.log")
    with pytest.raises(ServiceFailed, match="workers"):
        service.wait_until_ready()
    assert service.stop() == 2


async def test_what_ends_badly_keeps_nothing_else_from_its_end(tmp_path, monkeypatch):
    """Queued rows are written, and the folder is released."""
    settings = Settings(workers=1, spare_workers=0, grpc_port=0, http_port=0, data_dir=str(tmp_path))
    server = Server(settings)

    async def fail():
        raise RuntimeError("the port does not close")

    monkeypatch.setattr(server._http, "stop", fail)
    server.stop()
    with pytest.raises(RuntimeError, match="does not close"):
        await server.run(lambda *_: None, lambda _: None)
    Store(settings, Metrics()).close()


def test_what_a_library_prints_is_not_among_the_events(capsys):
    announcer = JsonAnnouncer()
    try:
        print("a node is lost")
        announcer.progress("compiling", 1, 2, "fuse")
    finally:
        announcer.close()
    events, log = capsys.readouterr()
    assert [json.loads(line)["done"] for line in events.splitlines()] == [1]
    assert log == "a node is lost\n"

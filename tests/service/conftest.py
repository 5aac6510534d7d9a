"""One running service for all tests, over real sockets, with real worker processes."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import queue
import signal
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import grpc
import httpx
import numpy as np
import pytest
from ddakf_api import API_VERSION, codec
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import SessionBusy, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from ddakf_client import connect
from ddakf_service.commands.service_process import ServiceProcess
from ddakf_service.server import Addresses, Server
from ddakf_service.settings import Settings
from ports import lasting_port
from postgres import NoPostgres, Postgres

TIMEOUT = 60.0  # seconds, of every call
T = TypeVar("T")


class Sheet(NamedTuple):
    """A square of cloth, (V, 3) metres and (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


def make_sheet(side: int = 12, spacing: float = 0.02) -> Sheet:
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    vertices = spacing * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    corner = (x[:-1, :-1] * side + y[:-1, :-1]).ravel()
    lower = np.stack([corner, corner + side, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + side, corner + side + 1], axis=1)
    return Sheet(vertices, np.concatenate([lower, upper]))


class Api:
    """Direct calls, for requests that the client library does not send."""

    def __init__(self, target: str, *options: tuple[str, int]):
        self.channel = grpc.insecure_channel(target, [("grpc.max_receive_message_length", 1 << 27), *options])
        self.stub = rpc.TrackingServiceStub(self.channel)

    def call(self, method: str, request):
        try:
            return getattr(self.stub, method)(request, timeout=TIMEOUT)
        except grpc.RpcError as error:
            raise from_rpc_error(error) from None

    def create(self, sheet: Sheet, session_id: str = "", request_id: str = "", **session) -> pb.Session:
        session = pb.Session(garment=pack_mesh(*sheet), **session)
        request = pb.CreateSessionRequest(
            api_version=API_VERSION, session=session, session_id=session_id, request_id=request_id
        )
        return self.call("CreateSession", request)

    def get(self, name: str) -> pb.Session:
        return self.call("GetSession", pb.GetSessionRequest(name=name))

    def delete(self, name: str) -> None:
        self.call("DeleteSession", pb.DeleteSessionRequest(name=name))

    def track(self, name: str, requests, flow=pb.FLOW_MODE_LOSSLESS, **start):
        """The responses to some requests, lazily."""
        begin = pb.Start(name=name, api_version=API_VERSION, flow_mode=flow, **start)
        stream = itertools.chain([pb.TrackRequest(start=begin)], requests)
        try:
            yield from self.stub.Track(stream, timeout=TIMEOUT)
        except grpc.RpcError as error:
            raise from_rpc_error(error) from None


def frame_of(sheet: Sheet, number: int, *, shift=(0.0, 0.0, 0.0), codec_name: str = "morton-zstd") -> pb.Frame:
    """The sheet itself as a cloud, frame `number` at 30 frames per second."""
    cloud = codec.encode(sheet.vertices + np.asarray(shift), codec_name).cloud
    return pb.Frame(sequence_number=number, capture_time=number / 30, point_cloud=cloud)


def request_of(frame: pb.Frame) -> pb.TrackRequest:
    return pb.TrackRequest(frame=frame)


class Talk:
    """An open stream whose requests depend on its responses. The requests end with the context."""

    def __init__(self, api: Api, name: str, **start):
        self._requests = queue.Queue()
        self.answers = api.track(name, iter(self._requests.get, None), **start)
        self.started = next(self.answers).started

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._requests.put(None)

    def send(self, frame: pb.Frame) -> None:
        self._requests.put(request_of(frame))

    def ask(self, frame: pb.Frame) -> list[pb.TrackResponse]:
        """The responses up to the one to this frame."""
        self.send(frame)
        seen = []
        while not (seen and seen[-1].WhichOneof("message") in ("result", "frame_error")):
            seen.append(next(self.answers))
        return seen

    def await_arrival(self) -> None:
        """Returns when the server has read all requests; no response may be pending."""
        self._requests.put(pb.TrackRequest(ping=pb.Ping(token=1)))
        assert next(self.answers).pong.token == 1

    def end(self) -> None:
        """Ends the requests; no response may be pending."""
        self._requests.put(None)
        assert list(self.answers) == []


def is_free(api: Api, name: str) -> bool:
    """Whether a session has no stream."""
    try:
        list(api.track(name, []))
    except SessionBusy:
        return False
    return True


def children(pid: int) -> list[int]:
    """Processes whose parent is `pid`."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(status.read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):
            continue  # it has ended meanwhile
        if parent == pid:
            found.append(int(status.parent.name))
    return found


def workers(pid: int) -> list[int]:
    """Worker processes of the server `pid`, the oldest first; they take frames, or are spare."""
    return sorted(child for child in children(pid) if name_of(child) == "ddakf-worker")


def fork_server(pid: int) -> int | None:
    """Fork server of the server `pid`."""
    return next((child for child in children(pid) if name_of(child) == "ddakf-forkserv"), None)


def name_of(pid: int) -> str:
    """Name of a process, as `ps` shows it; empty when it has ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


@contextlib.contextmanager
def held(pids: Sequence[int]) -> Iterator[None]:
    """Context in which processes are stopped."""
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


def is_running(pid: int) -> bool:
    """Whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def eventually(what: Callable[[], T], seconds: float = TIMEOUT) -> T:
    """The first true answer."""
    deadline = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < deadline, "it never came"
        time.sleep(0.02)
    return found


@contextlib.contextmanager
def running(arguments: Sequence[str], folder: Path) -> Iterator[ServiceProcess]:
    """A ready service, which must end in order; its log is "service.log" in the folder."""
    process = ServiceProcess(arguments, log=folder / "service.log")
    try:
        process.wait_until_ready()
        yield process
    finally:
        status = process.stop()
    assert status == 0


@contextlib.asynccontextmanager
async def serving(**settings) -> AsyncIterator[Addresses]:
    """A ready service in this process, with one worker process."""
    everything = {"workers": 1, "grpc_port": 0, "http_port": 0, "data_dir": "none", **settings}
    server, ready = Server(Settings(**everything)), asyncio.Future()
    running = asyncio.create_task(server.run(lambda *_: None, ready.set_result))
    try:
        yield await asyncio.wait_for(ready, TIMEOUT)
    finally:
        server.stop()
        await running


@pytest.fixture(scope="session")
def sheet() -> Sheet:
    return make_sheet()


@pytest.fixture(scope="session")
def service(tmp_path_factory):
    with running(["--workers", "2"], tmp_path_factory.mktemp("service")) as service:
        yield service


@pytest.fixture(scope="session")
def postgres():
    """A running PostgreSQL. A test that stops it must start it again."""
    try:
        cluster = Postgres()
    except NoPostgres as error:
        pytest.skip(str(error))
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.remove()


@pytest.fixture(scope="session")
def moto():
    """Port of a server with the S3 interface."""
    pytest.importorskip("s3fs", reason="s3fs is not installed: pip install 'ddakf[s3]'")
    pytest.importorskip("moto.server", reason="moto is not installed: pip install 'ddakf[s3-tests]'")
    port = lasting_port()
    process = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        eventually(lambda: _answers(port))
        yield port
    finally:
        process.terminate()
        process.wait()


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def api(service):
    api = Api(service.grpc)
    with api.channel:
        yield api


@pytest.fixture
def client(service):
    with connect(service.grpc, timeout=TIMEOUT) as client:
        yield client


@pytest.fixture
def http(service):
    with httpx.Client(base_url=service.http, timeout=TIMEOUT) as http:
        yield http


@pytest.fixture
def session(api, sheet):
    """The name of a fresh session."""
    name = api.create(sheet).name
    yield name
    api.delete(name)

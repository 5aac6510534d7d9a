"""Checkpoints and meshes on a real S3 interface: moto's server, behind a relay that cuts, holds and delays."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import select
import socket
import threading
import time
import uuid

import httpx
import pytest
from ddakf_api.errors import Unavailable
from ddakf_service.observability.metrics import Metrics
from ddakf_service.server import Addresses
from ddakf_service.sessions.recovery.persistence import Persistence
from ddakf_service.sessions.recovery.tenure import Tenure
from ddakf_service.sessions.session import Session
from ddakf_service.settings import Settings
from ddakf_service.store.files.checkpoints import Checkpoints
from ddakf_service.store.meshes import MeshRecord
from ddakf_service.store.store import Store

from ...conftest import Api, Sheet, Talk, eventually, frame_of, serving
from ..conftest import PATIENCE
from .test_checkpoints import pb, snapshot

pytestmark = pytest.mark.slow

fsspec_config = pytest.importorskip("fsspec.config")
pytest.importorskip("s3fs", reason="s3fs is not installed: pip install 'ddakf[s3]'")


class Relay:
    """A TCP relay to a port of this machine.

    Attributes:
        cuts: connections are closed at once, open ones too. holds: nothing passes. delay: seconds, of each part of an answer.
    """

    def __init__(self, port: int):
        self._target = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self.cuts = self.holds = False
        self.delay = 0.0
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self.cuts = True
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._relay, args=(client,), daemon=True).start()

    def _relay(self, client: socket.socket) -> None:
        with client, socket.create_connection(self._target) as server, contextlib.suppress(OSError):
            other = {client: server, server: client}
            while not self.cuts:
                readable, _, _ = select.select([] if self.holds else [client, server], [], [], 0.02)
                for end in readable:
                    if not (part := end.recv(1 << 16)):
                        return
                    time.sleep(self.delay if end is server else 0.0)
                    other[end].sendall(part)


@pytest.fixture
def relay(moto):
    relay = Relay(moto)
    yield relay
    relay.close()


@pytest.fixture
def url(request, relay, monkeypatch):
    """A new bucket, reached through the relay; timeouts are short where a test has an outage."""
    import s3fs

    seconds = 1 if "outage" in request.fixturenames else 30
    timeouts = {"connect_timeout": seconds, "read_timeout": seconds, "retries": {"max_attempts": 1}}
    options = {"endpoint_url": relay.url, "key": "a", "secret": "b", "config_kwargs": timeouts}
    monkeypatch.setitem(fsspec_config.conf, "s3", options)
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
    bucket = f"bucket-{uuid.uuid4()}"
    s3fs.S3FileSystem(skip_instance_cache=True).mkdir(bucket)
    return f"s3://{bucket}/some/prefix"


@pytest.fixture
def opened(url):
    made = []

    def open_(folder: str = "here") -> Checkpoints:
        made.append(Checkpoints(url, folder, 2, Metrics()))
        made[-1].open()
        return made[-1]

    yield open_
    for checkpoints in made:
        checkpoints.close()


async def test_the_newest_checkpoint_of_a_session_is_read_by_another_server(opened):
    checkpoints = opened()
    for number in range(1, 5):
        checkpoints.save(7, snapshot(number))
        assert await asyncio.to_thread(checkpoints.flush, PATIENCE)
    checkpoints.save(8, snapshot(9))
    assert await checkpoints.written(8, PATIENCE)
    again = opened()
    assert [await again.newest(uid) for uid in (7, 8, 9)] == [snapshot(4), snapshot(9), None]
    assert sorted(await again.stored()) == [7, 8]
    assert len(again._generations(7)) == 2
    again.delete(7)
    assert await asyncio.to_thread(again.flush, PATIENCE)
    assert await again.stored() == [8]


async def test_an_earlier_lease_does_not_hide_a_later_one(opened):
    earlier, later = opened(), opened()
    later.save(7, snapshot(2)._replace(epoch=2))
    assert await later.written(7, PATIENCE)
    earlier.save(7, snapshot(1)._replace(epoch=1))
    assert await earlier.written(7, PATIENCE)
    assert await opened().newest(7) == snapshot(2)


@pytest.mark.parametrize("outage", ["cuts", "holds"])
async def test_an_outage_is_a_problem_and_loses_no_checkpoint(opened, relay, outage):
    """Savers do not wait, the newest checkpoint stays in memory, and it is written when the store is back."""
    checkpoints = opened()
    checkpoints.save(7, snapshot(1))
    assert await checkpoints.written(7, PATIENCE)
    setattr(relay, outage, True)
    checkpoints.save(7, snapshot(2))
    began = time.monotonic()
    for _ in range(1000):
        checkpoints.save(8, snapshot(3))
    assert time.monotonic() - began < 1.0
    await asyncio.to_thread(eventually, lambda: checkpoints.condition.problem, PATIENCE)
    assert await checkpoints.newest(7) == snapshot(2)
    for read in (lambda: checkpoints.newest(9), checkpoints.stored):
        with pytest.raises(OSError, match=r"(?i)connect|timeout"):
            await read()
    setattr(relay, outage, False)
    assert await asyncio.to_thread(checkpoints.flush, PATIENCE)
    assert checkpoints.condition.problem == ""
    again = opened()
    assert [await again.newest(uid) for uid in (7, 8)] == [snapshot(2), snapshot(3)]


async def test_frames_go_on_while_a_slow_store_takes_a_checkpoint(url, relay, sheet):
    """It works, and each of its answers takes much longer than a frame."""
    async with serving(checkpoint_url=url, checkpoint_every=1) as addresses:
        relay.delay = 0.3
        meanwhile = await asyncio.to_thread(_frames_until_a_checkpoint, addresses, sheet)
        assert meanwhile > 3
        readiness = await asyncio.to_thread(httpx.get, f"{addresses.http}/readyz")
        assert readiness.json()["status"] == "ready"


def _frames_until_a_checkpoint(addresses: Addresses, sheet: Sheet) -> int:
    """Answered frames of a session until its first checkpoint is written."""
    api = Api(addresses.grpc)
    name = api.create(sheet).name
    with api.channel, Talk(api, name) as talk:
        for number in itertools.count(1):
            talk.ask(frame_of(sheet, number))
            if "ddakf_checkpoint_seconds_count 0.0" not in httpx.get(f"{addresses.http}/metrics").text:
                return number


@pytest.fixture
async def store(url, tmp_path):
    store = Store(Settings(data_dir=str(tmp_path / "data"), checkpoint_url=url), Metrics())
    yield store
    await asyncio.to_thread(store.close)


async def test_callers_get_one_kind_of_error_while_the_store_is_away(store, relay):
    """A session stays and its client may come again; the same holds for meshes."""
    name = store.require_name
    persistence = Persistence(store.registry, store.history, store.checkpoints, store.server_id, name, Tenure())
    session = Session("some", pb.Session(), pb.Session(), pb.SessionLimits())
    relay.cuts = True
    with pytest.raises(Unavailable, match="the checkpoints of sessions/some cannot be read now"):
        await persistence.newest(session)
    with pytest.raises(Unavailable, match="meshes"):
        await store.meshes.add(MeshRecord("0" * 32, "key", 3, 1, 4, 1.0), b"mesh")
    relay.cuts = False
    assert await persistence.newest(session) is None


def test_a_store_without_options_of_ours_has_bounded_waits(monkeypatch):
    from ddakf_service.store.files.object_store import file_system

    monkeypatch.delitem(fsspec_config.conf, "s3", raising=False)
    files, path = file_system("s3://bucket/prefix")
    assert path == "bucket/prefix"
    assert files.config_kwargs["read_timeout"] <= 10

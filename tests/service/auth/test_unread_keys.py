"""Keys that cannot be read when the server starts: it is not ready before they are."""

from __future__ import annotations

import asyncio
import logging
import time

import httpx
import pytest
from ddakf_service.auth import keys
from ddakf_service.auth.principal import Scope
from ddakf_service.sessions import lifecycle
from grpc import aio
from grpc_health.v1 import health_pb2, health_pb2_grpc

from ..conftest import TIMEOUT, eventually, serving
from ..transports.http_alone import http_alone

SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING
NO_KEY = "no key exists"


@pytest.fixture
def database(tmp_path, monkeypatch):
    """A place at which a folder stands in the way of the database, until it is removed."""
    monkeypatch.setattr(keys, "_REFRESH", 0.05)
    monkeypatch.setattr(lifecycle, "LOAD_RETRY_INTERVAL", 0.05)
    place = tmp_path / "ddakf.sqlite"
    place.mkdir()
    return place


def test_a_server_without_its_keys_is_not_ready_and_names_the_reason(database, caplog):
    caplog.set_level(logging.INFO)
    with http_alone(require_keys=True, database_url=f"sqlite:///{database}") as port:
        answer = httpx.get(port.url + "/readyz")
        assert (answer.status_code, answer.json()["error"]["message"]) == (503, "the keys have not been read yet")
        assert NO_KEY not in caplog.text
        database.rmdir()
        eventually(lambda: "kernels" in httpx.get(port.url + "/readyz").json()["error"]["message"])
        assert NO_KEY in caplog.text


def test_a_server_that_needs_no_key_waits_for_none(database):
    with http_alone(database_url=f"sqlite:///{database}") as port:
        assert "kernels" in httpx.get(port.url + "/readyz").json()["error"]["message"]


def test_the_log_of_an_outage_has_its_beginning_and_its_end_with_the_reason(database, caplog):
    caplog.set_level(logging.INFO)
    with http_alone(require_keys=True, database_url=f"sqlite:///{database}"):
        time.sleep(0.3)  # several attempts
        database.rmdir()
        eventually(lambda: "earlier sessions are loaded" in caplog.text and "keys can be read again" in caplog.text)
    lines = [record.getMessage() for record in caplog.records if record.name.startswith("ddakf_service")]
    for part in ("keys can", "earlier sessions"):
        begin, end = (line for line in lines if part in line)
        assert "Is a directory" in begin
        assert "again" in end or "now" in end


async def test_a_key_that_expires_while_the_keys_cannot_be_read_loses_its_streams(monkeypatch):
    monkeypatch.setattr(keys, "_REFRESH", 0.05)
    key, _ = keys.generate("short", [Scope.STREAM], time.time(), keys.KeyLimits(expires=time.time() + 0.3))
    stored, ended = [key], asyncio.Event()

    class Stored:
        def all(self):
            return [stored.pop()]  # the second time there is none

    ring = keys.KeyRing(Stored(), lambda ids: ended.set() if key.id in ids else None)
    await ring.start()
    assert not ended.is_set()
    await asyncio.wait_for(ended.wait(), TIMEOUT)
    await ring.stop()


@pytest.mark.slow
async def test_a_server_becomes_ready_when_the_keys_are_read(database):
    async with serving(require_keys=True, database_url=f"sqlite:///{database}", spare_workers=0) as addresses:

        async def readiness() -> tuple[int, int]:
            async with aio.insecure_channel(addresses.grpc) as channel, httpx.AsyncClient() as http:
                health = await health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest())
                return (await http.get(addresses.http + "/readyz")).status_code, health.status

        assert await readiness() == (503, NOT_SERVING)
        database.rmdir()
        async with asyncio.timeout(30):
            while await readiness() != (200, SERVING):
                await asyncio.sleep(0.1)

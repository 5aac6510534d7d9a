"""Refused calls, and the changes of keys: what the metrics and the log tell of them."""

from __future__ import annotations

import logging
from pathlib import Path

import grpc
import httpx
import pytest
from ddakf_api.errors import PermissionDenied
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from ddakf_service.auth import keys, refusals
from ddakf_service.auth.guard import Guard
from ddakf_service.observability.metrics import Metrics
from ddakf_service.transports.grpc.guard import GrpcGuard
from prometheus_client.parser import text_string_to_metric_families

from ddakf.commands import cli

from ..conftest import TIMEOUT, eventually
from ..transports.http_alone import http_alone

UNKNOWN = "ddakf_0123456789ab_" + 43 * "A"


@pytest.fixture
def place(tmp_path, monkeypatch, caplog):
    """A data folder. The keys are read often."""
    monkeypatch.setattr(keys, "_REFRESH", 0.1)
    caplog.set_level(logging.INFO)
    return tmp_path / "data"


class NoKeys:
    """A store without keys."""

    def all(self) -> list:
        return []


def keys_command(place: Path, capsys, *arguments: str) -> str:
    """The output of `ddakf keys`, in this process."""
    assert cli.main(["keys", "--data-dir", str(place), *arguments]) == 0
    return capsys.readouterr().out.strip()


def counted(port, key: str) -> dict[str, float]:
    text = httpx.get(port.url + "/metrics", headers={"authorization": f"Bearer {key}"}).text
    families = {family.name: family for family in text_string_to_metric_families(text)}
    return {sample.labels["reason"]: sample.value for sample in families["ddakf_calls_refused"].samples}


def lines(caplog, begin: str) -> list[logging.LogRecord]:
    return [record for record in caplog.records if record.getMessage().startswith(begin)]


def test_refused_calls_are_counted_and_logged_without_a_flood(place, caplog, capsys):
    key = keys_command(place, capsys, "create", "reader", "--scope", "read")
    with http_alone(require_keys=True, data_dir=str(place)) as port, httpx.Client(base_url=port.url) as http:
        for _ in range(20):
            http.get("/v1/sessions")
        http.get("/v1/sessions", headers={"authorization": f"Bearer {UNKNOWN}"})
        http.post("/v1/sessions", headers={"authorization": f"Bearer {key}"})
        http.get("/v1/sessions", headers={"origin": "https://elsewhere.example"})
        expected = {"no_key": 20, "invalid_key": 1, "scope": 1, "rate": 0, "unread_keys": 0, "origin": 1}
        assert counted(port, key) == expected
    logged = {record.reason: record for record in lines(caplog, "a call was refused")}
    assert len(lines(caplog, "a call was refused")) == len(logged) == 4
    assert (logged["no_key"].call, logged["no_key"].key) == ("GET /v1/sessions", "-")
    assert logged["no_key"].peer.startswith("127.0.0.1:")
    assert logged["invalid_key"].key == "0123456789ab"
    assert logged["scope"].key == key.split("_")[1]
    for presented in (UNKNOWN, key):
        assert presented.split("_", 2)[2] not in caplog.text


def test_the_next_line_tells_how_many_calls_had_none(monkeypatch, caplog):
    now = 1000.0
    monkeypatch.setattr(refusals, "monotonic", lambda: now)
    door, error = refusals.Refusals(Metrics().calls_refused), PermissionDenied("no")
    for _ in range(5):
        door.record(error, UNKNOWN, "GET /", "peer")
    now += 11
    door.record(error, UNKNOWN, "GET /", "peer")
    assert [record.calls for record in caplog.records] == [1, 5]


async def test_a_refused_call_of_grpc_is_logged_with_its_method_and_caller(caplog):
    ring = keys.KeyRing(NoKeys(), on_revoked=set)
    await ring.start()
    door = Guard(ring, refusals.Refusals(Metrics().calls_refused), anonymous=False, local=False)
    server = grpc.aio.server(interceptors=[GrpcGuard(door)])
    rpc.add_TrackingServiceServicer_to_server(rpc.TrackingServiceServicer(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        with pytest.raises(grpc.RpcError):
            await rpc.TrackingServiceStub(channel).ListMeshes(pb.ListMeshesRequest(), timeout=TIMEOUT)
    await server.stop(None)
    await ring.stop()
    (line,) = lines(caplog, "a call was refused")
    assert (line.reason, line.call) == ("no_key", "/ddakf_api.v1.TrackingService/ListMeshes")
    assert line.peer.startswith("ipv4:127.0.0.1:")


def test_the_log_tells_when_a_key_is_created_and_revoked(place, caplog, capsys):
    keys_command(place, capsys, "create", "first", "--scope", "read")
    with http_alone(require_keys=True, data_dir=str(place)):
        key_id = keys_command(place, capsys, "create", "second", "--scope", "stream").split("_")[1]
        eventually(lambda: lines(caplog, "a key was created"))
        keys_command(place, capsys, "revoke", key_id)
        eventually(lambda: lines(caplog, "a key was revoked"))
    (created,), (revoked,) = lines(caplog, "a key was created"), lines(caplog, "a key was revoked")
    assert (created.key, created.scopes, revoked.key) == (key_id, "stream", key_id)

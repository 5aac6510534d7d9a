"""Connections over HTTP and WebSocket: timeouts, origins of pages, security headers."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from websockets.exceptions import InvalidStatus

from ..conftest import Api, eventually, frame_of, make_sheet, request_of, running
from .websockets_client import START, handshake, line

pytestmark = pytest.mark.slow

ORIGIN = "https://example.org"


@pytest.fixture(scope="module")
def strict(tmp_path_factory):
    """A service with small messages, short pings, one foreign origin and a short drain."""
    settings = ["--workers", "1", "--max-message-bytes", "100000", "--keepalive", "1", "--cors-origins", ORIGIN]
    settings += ["--reader-timeout", "1000"]  # what cuts a silent client off here is the keepalive
    settings += ["--drain-grace", "0.5", "--spare-workers", "0"]  # a spare that starts later would be one more descriptor
    with running(settings, tmp_path_factory.mktemp("strict")) as service:
        yield service


@pytest.fixture
def strict_session(strict, sheet):
    api = Api(strict.grpc)
    with api.channel:
        name = api.create(sheet).name
        yield api, name
        api.delete(name)


def test_a_message_above_the_limit_ends_the_connection_and_leaves_the_session(strict, strict_session, sheet):
    api, name = strict_session
    huge = frame_of(sheet, 2)
    huge.body_vertices = b"\0" * 100_000
    with line(strict, f"{name}/stream") as websocket:
        websocket.send(START)
        websocket.send(request_of(frame_of(sheet, 1)))
        assert [websocket.receive().WhichOneof("message") for _ in range(2)] == ["started", "result"]
        websocket.send(request_of(huge))
        assert websocket.ending()[0] == 1009
    assert next(api.track(name, [], takeover=True)).started.last_sequence_number == 1


def descriptors(service) -> int:
    return len(os.listdir(f"/proc/{service.pid}/fd"))


def test_a_dead_client_is_noticed_by_its_silence(strict, strict_session, sheet):
    """It keeps the connection and answers no ping; its session accepts another stream."""
    _, name = strict_session
    before = descriptors(strict)
    data = START.SerializeToString()
    with handshake(strict, f"{name}/stream") as dead:
        dead.sendall(bytes([0x82, 0x80 | len(data), 0, 0, 0, 0]) + data)  # a binary frame, masked with zeros
        eventually(lambda: httpx.get(f"{strict.http}/v1/{name}").json()["state"] != "SESSION_STATE_IDLE")
        eventually(lambda: httpx.get(f"{strict.http}/v1/{name}").json()["state"] == "SESSION_STATE_IDLE")
        eventually(lambda: descriptors(strict) <= before)
        received = b"".join(iter(lambda: dead.recv(1 << 16), b""))
    assert b"keepalive ping timeout" in received
    with line(strict, f"{name}/stream") as websocket:
        websocket.send(START)
        assert websocket.receive().started.name == name


def ping(connection: socket.socket, over: threading.Event) -> None:
    with contextlib.suppress(ConnectionError):
        while not over.wait(0.02):
            connection.sendall(b"\x89\x80\0\0\0\0" * 5)


@pytest.mark.parametrize("pings", [False, True])
def test_a_watcher_that_never_reads_is_cut_off(strict, sheet, pings):
    """It gets more data than any buffer holds, which an orderly close would wait for. Its pings say
    that it lives, not that it reads."""
    api, large = Api(strict.grpc), make_sheet(40, 0.01)
    with api.channel:
        name = api.create(large).name
        before = descriptors(strict)
        options = pb.ResultOptions(include_covariance=True, vertex_encoding=pb.ARRAY_ENCODING_FLOAT64)
        with handshake(strict, f"{name}/watch?api_version=1.0") as deaf, ThreadPoolExecutor(1) as thread:
            over = threading.Event()
            pinging = thread.submit(ping, deaf, over) if pings else None
            try:
                requests = [request_of(frame_of(large, i)) for i in range(1, 151)]
                responses = list(api.track(name, requests, result_options=options))
                assert len(responses) == 151
                eventually(lambda: descriptors(strict) <= before)
            finally:
                over.set()
            if pinging:
                pinging.result()
            assert deaf.fileno() >= 0, "this side keeps the connection"
        api.delete(name)


def test_a_client_that_answers_pings_stays(strict, strict_session, sheet):
    _, name = strict_session
    with line(strict, f"{name}/stream") as websocket:
        websocket.send(START)
        websocket.receive()
        time.sleep(2.5)  # two pings
        websocket.send(request_of(frame_of(sheet, 1)))
        assert websocket.receive().result.sequence_number == 1


def test_a_client_whose_pong_waits_behind_its_frames_stays(strict):
    """It sends all frames at once, and the server reads them only as fast as they are tracked."""
    api, large = Api(strict.grpc), make_sheet(40, 0.01)
    with api.channel:
        name = api.create(large).name
        count = 150  # several times as long as a client has to answer a ping
        with line(strict, f"{name}/stream") as websocket:
            results = websocket.track([request_of(frame_of(large, i)) for i in range(1, count + 1)])[1:]
            assert websocket.connection.close_code == 1000
        assert [answer.result.sequence_number for answer in results] == list(range(1, count + 1))
        api.delete(name)


@pytest.mark.parametrize(
    ("origin", "host", "status"),
    [
        (None, None, 101),
        (ORIGIN, None, 101),
        ("http://127.0.0.1:{port}", None, 101),
        ("http://[::1]:{port}", "[::1]:{port}", 101),
        ("http://localhost:{port}", "localhost:{port}", 101),
        ("http://127.0.0.1:1", None, 403),
        ("https://example.com", None, 403),
        (ORIGIN + ".evil.com", None, 403),
        ("null", None, 403),
        ("http://rebound.example:{port}", "rebound.example:{port}", 403),
    ],
)
def test_pages_of_foreign_origins_are_refused(strict, strict_session, origin, host, status):
    _, name = strict_session
    port = httpx.URL(strict.http).port
    headers = {key: value.format(port=port) for key, value in (("Origin", origin), ("Host", host)) if value}
    answer = httpx.get(f"{strict.http}/v1/{name}", headers=headers)
    assert answer.status_code == (200 if status == 101 else 403)
    assert answer.headers.get("access-control-allow-origin") == (ORIGIN if origin == ORIGIN else None)
    if status == 403:
        assert answer.json()["error"]["name"] == "PermissionDenied"
    if host:
        return  # the client library sets its own
    attempt = line(strict, f"{name}/watch?api_version=1.0", origin=headers.get("Origin"))
    if status == 101:
        with attempt as watcher:
            assert watcher.receive().started.name == name
        return
    with pytest.raises(InvalidStatus) as caught, attempt:
        pass
    assert caught.value.response.status_code == 403
    assert "cors_origins" in json.loads(caught.value.response.body)["error"]["message"]


def test_an_allowed_page_can_read_why_its_key_is_refused(strict):
    answer = httpx.get(f"{strict.http}/v1/sessions", headers={"Origin": ORIGIN, "Authorization": "Bearer wrong"})
    assert (answer.status_code, answer.json()["error"]["name"]) == (401, "Unauthenticated")
    assert answer.headers["access-control-allow-origin"] == ORIGIN


def test_preflights_are_answered_for_the_origins_of_the_setting_alone(strict, http):
    asked = {"Access-Control-Request-Method": "PATCH", "Access-Control-Request-Headers": "content-type"}
    allowed = httpx.options(f"{strict.http}/v1/sessions", headers={"Origin": ORIGIN, **asked})
    assert allowed.status_code == 200
    assert "PATCH" in allowed.headers["access-control-allow-methods"]
    for client, url in ((httpx, f"{strict.http}/v1/sessions"), (http, "/v1/sessions")):
        refused = client.options(url, headers={"Origin": "https://example.com", **asked})
        assert refused.status_code == 403
        assert not any(name.startswith("access-control") for name in refused.headers)


def test_every_answer_has_security_headers(http):
    for path in ("/healthz", "/v1/sessions", "/v1/sessions/nobody", "/nothing", "/metrics", "/docs"):
        headers = http.get(path).headers
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert headers["cache-control"] == "no-store"
        assert "default-src 'none'; frame-ancestors 'none'" in headers["content-security-policy"]
        assert "server" not in headers


def test_a_flood_of_headers_is_refused(http):
    with contextlib.suppress(httpx.TransportError):  # the connection is closed, perhaps while they still come
        assert http.get("/healthz", headers={f"x-{i}": "y" * 10_000 for i in range(100)}).status_code == 431
    assert http.get("/healthz").status_code == 200


def test_a_stop_is_announced_and_then_closes(strict, sheet):
    """The last test of this service, because it stops it."""
    api = Api(strict.grpc)
    with api.channel:
        name = api.create(sheet).name
    with line(strict, f"{name}/stream") as stream, line(strict, f"{name}/watch?api_version=1.0") as watcher:
        stream.send(START)
        assert [each.receive().WhichOneof("message") for each in (stream, watcher)] == ["started"] * 2
        os.kill(strict.pid, signal.SIGTERM)
        for each in (stream, watcher):
            assert each.receive().notice.kind == pb.NOTICE_KIND_DRAINING
            code, reason = each.ending()
            assert (code, reason) == (4503, "the server has stopped; connect again later or elsewhere")
    assert strict.wait() == 0

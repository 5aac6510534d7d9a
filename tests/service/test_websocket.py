"""Streams and watchers over WebSocket: what gRPC carries, in binary and in text frames."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import time
from pathlib import Path
from typing import NamedTuple

import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.child import ServiceProcess
from google.protobuf import json_format
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from .conftest import TIMEOUT, Api, frame_of, make_sheet, request_of

ROOT = Path(__file__).resolve().parents[2]
ORIGIN = "https://example.org"
START = pb.TrackRequest(start=pb.Start(api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS))


class Line:
    """A WebSocket of one of the two modes, in terms of the contract's messages."""

    def __init__(self, connection, mode: str):
        self.connection, self._json = connection, mode == "json"

    def send(self, request: pb.TrackRequest | None) -> None:
        if self._json:
            self.connection.send(json_format.MessageToJson(request) if request else "{}")
        else:
            self.connection.send(request.SerializeToString() if request else b"")

    def receive(self) -> pb.TrackResponse:
        message = self.connection.recv(timeout=TIMEOUT)
        assert isinstance(message, str) == self._json
        if self._json:
            return json_format.Parse(message, pb.TrackResponse())
        return pb.TrackResponse.FromString(message)

    def track(self, requests) -> list[pb.TrackResponse]:
        """All the responses to a start, some requests, and the empty message."""
        for request in (START, *requests, None):
            self.send(request)
        responses = []
        with contextlib.suppress(ConnectionClosed):
            while True:
                responses.append(self.receive())
        return responses

    def ending(self) -> tuple[int, str]:
        """Close code and reason, whatever comes before."""
        with pytest.raises(ConnectionClosed) as caught:  # noqa: PT012
            while True:
                self.connection.recv(timeout=TIMEOUT)
        return caught.value.rcvd.code, caught.value.rcvd.reason


@contextlib.contextmanager
def line(service, path: str, mode: str = "binary", **options):
    url = f"{service.http.replace('http', 'ws', 1)}/v1/{path}"
    url += ("&" if "?" in path else "?") + f"mode={mode}"
    with connect(url, max_size=None, proxy=None, open_timeout=TIMEOUT, **options) as connection:
        yield Line(connection, mode)


def without_timings(responses) -> list[pb.TrackResponse]:
    for response in responses:
        response.result.ClearField("timings") if response.HasField("result") else None
    return responses


@pytest.mark.parametrize("mode", ["binary", "json"])
def test_both_modes_answer_what_grpc_answers(service, api, sheet, mode):
    spoilt = frame_of(sheet, 2)
    spoilt.point_cloud.data = b"?"
    requests = [request_of(f) for f in (frame_of(sheet, 1), spoilt, frame_of(sheet, 3, shift=(0.003, 0, 0)))]
    requests.append(pb.TrackRequest(ping=pb.Ping(token=2**60)))
    answers = []
    for transport in ("grpc", mode):
        name = api.create(sheet, "the-same-name").name
        if transport == "grpc":
            responses = list(api.track(name, requests))
        else:
            with line(service, f"{name}/stream", mode) as websocket:
                responses = websocket.track(requests)
                assert websocket.connection.close_code == 1000
        pongs = [response.pong.token for response in responses if response.HasField("pong")]
        answers.append((without_timings([r for r in responses if not r.HasField("pong")]), pongs))
        api.delete(name)
    assert [r.WhichOneof("message") for r in answers[0][0]] == ["started", "result", "frame_error", "result"]
    assert answers[0] == answers[1]


@pytest.mark.parametrize("mode", ["binary", "json"])
def test_a_watcher_sees_the_clients_answers(service, api, session, sheet, mode):
    list(api.track(session, [request_of(frame_of(sheet, 1))]))
    with line(service, f"{session}/watch?api_version=1.0&every_nth=1", mode) as watcher:
        started = watcher.receive().started
        assert (started.name, started.last_sequence_number) == (session, 1)
        _, *answers = api.track(session, [request_of(frame_of(sheet, i)) for i in (2, 3)])
        assert [watcher.receive() for _ in answers] == answers


def test_a_watcher_is_told_the_end_and_only_reads(service, api, sheet):
    name = api.create(sheet).name
    with line(service, f"{name}/watch?api_version=1.0") as watcher, line(service, f"{name}/watch?api_version=1.0") as other:
        assert (watcher.receive(), other.receive()) != (None, None)
        other.send(START)
        assert other.ending() == (4409, "a watcher only reads")
        api.delete(name)
        assert watcher.ending() == (4404, f"{name} was deleted")
    with line(service, f"{name}/watch?api_version=1.0&every_nth=often") as refused:
        assert refused.ending()[0] == 4422


class Wrong(NamedTuple):
    """What a client does, and how its stream ends."""

    send: object
    code: int
    words: str
    query: str = ""
    path: str = ""


FRAME = request_of(frame_of(make_sheet(), 1)).SerializeToString()
WRONG = {
    "no such session": Wrong([START.SerializeToString()], 4404, "no session", path="sessions/nobody"),
    "no start": Wrong([pb.TrackRequest(ping=pb.Ping()).SerializeToString()], 4409, "has to be start"),
    "nothing at all": Wrong([b""], 4409, "has to be start"),
    "no message": Wrong([b"\xff\xff\xff"], 4422, "a serialised TrackRequest, got 3 bytes"),
    "text in binary mode": Wrong(["{}"], 4422, "mode=json"),
    "bytes in mode json": Wrong([b"{}"], 4422, "a text frame", "mode=json"),
    "no JSON": Wrong(["{"], 4422, "TrackRequest as JSON", "mode=json"),
    "deep JSON": Wrong(["[" * 10_000], 4422, "TrackRequest as JSON", "mode=json"),
    "unknown field": Wrong(['{"begin": {}}'], 4422, "begin", "mode=json"),
    "unknown mode": Wrong([], 4422, "binary or json", "mode=xml"),
    "another version": Wrong([pb.TrackRequest(start=pb.Start(api_version="9.0")).SerializeToString()], 4400, "speaks"),
    "another name": Wrong(
        [pb.TrackRequest(start=pb.Start(name="sessions/other", api_version=API_VERSION)).SerializeToString()], 4422, "start.name"
    ),
    "start twice": Wrong([START.SerializeToString()] * 2, 4422, "a frame or a ping, got start"),
    # the frame keeps the stream from its end until the message after it has come
    "more after the end": Wrong([START.SerializeToString(), FRAME, b"", b""], 4409, "no message may follow"),
    "a long sentence": Wrong([START.SerializeToString()], 4422, "...", query="mode=" + "é" * 60),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_stream_that_ends_with_an_error_says_why_in_its_close_code(service, session, case):
    wrong = WRONG[case]
    url = f"{service.http.replace('http', 'ws', 1)}/v1/{wrong.path or session}/stream?{wrong.query}"
    with connect(url, proxy=None, open_timeout=TIMEOUT) as connection:
        with contextlib.suppress(ConnectionClosed):
            for message in wrong.send:
                connection.send(message)
        code, reason = Line(connection, "").ending()
    assert code == wrong.code, reason
    assert wrong.words in reason
    assert len(reason.encode()) <= 123


def test_a_stream_is_taken_over_across_transports(service, api, session, sheet):
    with line(service, f"{session}/stream") as first:
        first.send(START)
        assert first.receive().started.name == session
        with line(service, f"{session}/stream") as second:
            second.send(START)
            assert second.ending()[0] == 4409
        list(api.track(session, [request_of(frame_of(sheet, 1))], takeover=True))
        code, reason = first.ending()
    assert (code, reason) == (4409, f"another stream took {session} over")


def test_nothing_is_compressed(service, session):
    with line(service, f"{session}/stream") as websocket:
        assert websocket.connection.protocol.extensions == []


def test_the_recipe_for_a_browsers_console(service, http):
    """What docs/protocol.md says to type, sent by another client of WebSocket."""
    recipe = (ROOT / "docs/protocol.md").read_text().partition("```js\n")[2].partition("```")[0]
    ((path, body),) = re.findall(r"""fetch\("([^"]+)", {method: "POST", body: '([^']+)'}\)""", recipe)
    assert http.post(path, content=body).status_code == 201
    (address,) = re.findall(r'new WebSocket\("ws://127.0.0.1:7702([^"]+)"\)', recipe)
    with connect(service.http.replace("http", "ws", 1) + address, proxy=None, open_timeout=TIMEOUT) as websocket:
        kinds, messages = [], re.findall(r"ws\.send\('([^']+)'\)", recipe)
        assert len(messages) == 4
        for message in messages[:-1]:
            websocket.send(message)
            kinds += json.loads(websocket.recv(timeout=TIMEOUT))
        websocket.send(messages[-1])
        code, _ = Line(websocket, "json").ending()
    assert (kinds, code) == (["started", "result", "pong"], 1000)
    (path,) = re.findall(r'fetch\("([^"]+)", {method: "DELETE"}\)', recipe)
    assert http.delete(path).status_code == 204


# A service of other settings -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def strict(tmp_path_factory):
    """Small messages, impatient pings, one foreign origin, a short farewell."""
    settings = ["--workers", "1", "--max-message-bytes", "100000", "--keepalive", "0.5", "--cors-origins", ORIGIN]
    settings += ["--drain-grace", "0.5"]
    process = ServiceProcess(settings, log=tmp_path_factory.mktemp("strict") / "service.log")
    try:
        process.wait_until_ready()
        yield process
    finally:
        process.stop()


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


def handshake(service, path: str) -> socket.socket:
    """A client that can leave pings unanswered, and for which its machine keeps little."""
    url = httpx.URL(service.http)
    connection = socket.socket()
    connection.settimeout(TIMEOUT)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 12)
    connection.connect((url.host, url.port))
    head = f"GET /v1/{path} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    connection.sendall(f"{head}Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
    assert b" 101 " in connection.recv(1 << 10)
    return connection


def descriptors(service) -> int:
    return len(os.listdir(f"/proc/{service.pid}/fd"))


def until(condition) -> bool:
    deadline = time.monotonic() + TIMEOUT
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    return condition()


def test_a_dead_client_is_noticed_by_its_silence(strict, strict_session, sheet):
    """It keeps the connection, answers no ping, and its session is free for another."""
    _, name = strict_session
    before = descriptors(strict)
    data = START.SerializeToString()
    with handshake(strict, f"{name}/stream") as dead:
        dead.sendall(bytes([0x82, 0x80 | len(data), 0, 0, 0, 0]) + data)  # a binary frame, masked with zeros
        assert until(lambda: httpx.get(f"{strict.http}/v1/{name}").json()["state"] != "idle")
        assert until(lambda: httpx.get(f"{strict.http}/v1/{name}").json()["state"] == "idle")
        assert until(lambda: descriptors(strict) <= before)
        received = b"".join(iter(lambda: dead.recv(1 << 16), b""))
    assert b"keepalive ping timeout" in received
    with line(strict, f"{name}/stream") as websocket:
        websocket.send(START)
        assert websocket.receive().started.name == name


def test_a_watcher_that_never_reads_is_cut_off(strict, sheet):
    """More is sent to it than any buffer holds, so that an orderly close would wait for it."""
    api, large = Api(strict.grpc), make_sheet(40, 0.01)
    with api.channel:
        name = api.create(large).name
        before = descriptors(strict)
        options = pb.ResultOptions(include_covariance=True, vertex_encoding=pb.ARRAY_ENCODING_FLOAT64)
        with handshake(strict, f"{name}/watch?api_version=1.0") as deaf:
            requests = [request_of(frame_of(large, i)) for i in range(1, 151)]
            responses = list(api.track(name, requests, result_options=options))
            assert len(responses) == 151
            assert until(lambda: descriptors(strict) <= before)
            assert deaf.fileno() >= 0, "this side keeps the connection"
        api.delete(name)


def test_a_client_that_answers_pings_stays(strict, strict_session, sheet):
    _, name = strict_session
    with line(strict, f"{name}/stream") as websocket:
        websocket.send(START)
        websocket.receive()
        time.sleep(2.0)  # four pings
        websocket.send(request_of(frame_of(sheet, 1)))
        assert websocket.receive().result.sequence_number == 1


def test_a_client_whose_pong_waits_behind_its_frames_stays(strict):
    """It sends them all at once, and the server takes them only as fast as they are tracked."""
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
    with pytest.raises(httpx.TransportError):  # the connection is closed while they still come
        http.get("/healthz", headers={f"x-{i}": "y" * 10_000 for i in range(100)})
    assert http.get("/healthz").status_code == 200


def test_a_stop_is_announced_and_then_closes(strict, sheet):
    """The last of the tests with this service, for it stops it."""
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

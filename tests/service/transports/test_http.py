"""HTTP: framing, methods, queries and refusals, over a real socket."""

from __future__ import annotations

import logging

import httpx
import pytest
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.sessions.page_token import Position, page_token, position_after
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from ..conftest import TIMEOUT
from .http_alone import http_alone

UPGRADE = (
    "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)


@pytest.fixture(scope="module")
def port():
    with http_alone() as port:
        yield port


@pytest.fixture
def http(port):
    with httpx.Client(base_url=port.url) as http:
        yield http


@pytest.mark.parametrize(
    ("path", "headers", "status", "name"),
    [
        ("/v1/sessions/some/watch", "Authorization: Bearer wrong\r\n", 401, "Unauthenticated"),
        ("/v1/sessions/some/watch", "Origin: https://example.org\r\n", 403, "PermissionDenied"),
        ("/v1/sessions/some/nothing", "", 404, "NotFound"),
        ("/healthz", "", 404, "NotFound"),
    ],
)
def test_a_refused_handshake_has_its_reason_and_is_no_error_of_the_server(port, caplog, path, headers, status, name):
    with caplog.at_level(logging.WARNING):
        answer = port.send(f"GET {path} HTTP/1.1\r\nHost: {{host}}\r\n{UPGRADE}{headers}\r\n")
    assert (answer.status, answer.error["name"]) == (status, name)
    assert [message for message in caplog.messages if not message.startswith("a call was refused")] == []


def test_an_opened_handshake_closes_with_what_is_wrong_in_its_query(port):
    for query, words in (
        ("mod=json", "did you mean mode"),
        ("mode=json&mode=binary", "one value, got 2"),
        ("mode=text", "binary or json"),
    ):
        address = f"ws{port.url[4:]}/v1/sessions/some/watch?{query}"
        with connect(address, open_timeout=TIMEOUT) as websocket, pytest.raises(ConnectionClosed) as closed:
            list(websocket)
        assert closed.value.rcvd.code == 4422
        assert words in closed.value.rcvd.reason


BODY = "2\r\n[]\r\n0\r\n\r\n"
POST = "POST /v1/sessions HTTP/1.1\r\nHost: {host}\r\n"


@pytest.mark.parametrize(
    "lengths", ["Content-Length: 2\r\nTransfer-Encoding: chunked\r\n", "Transfer-Encoding: chunked\r\ncontent-length: 12\r\n"]
)
def test_a_request_with_two_lengths_ends_its_connection(port, lengths):
    """The bytes after it may be a request that another server on the way has not seen."""
    smuggled = "GET /v1/info HTTP/1.1\r\nHost: {host}\r\n\r\n"
    answer = port.send(POST + lengths + "\r\n" + BODY + smuggled)
    assert answer.status == 422
    assert answer.headers["connection"] == "close"
    assert b"server_version" not in answer.body


@pytest.mark.parametrize(("lengths", "body"), [("Content-Length: 2\r\n", "[]"), ("Transfer-Encoding: chunked\r\n", BODY)])
def test_a_request_with_one_length_leaves_the_connection_open(port, lengths, body):
    assert port.send(POST + lengths + "\r\n" + body, until_closed=False).error["name"] == "InvalidArgument"


def chunked(size: int, count: int) -> str:
    """A body of equal chunks."""
    return POST + "Transfer-Encoding: chunked\r\n\r\n" + f"{size:x}\r\n{' ' * size}\r\n" * count + "0\r\n\r\n"


def test_a_body_of_tiny_chunks_is_refused(port):
    """One read of them would hold up all streams."""
    answer = port.send(chunked(1, 2_000))
    assert answer.status == 400
    assert "more than 1024 chunks of fewer than 128 bytes" in answer.error["message"]


@pytest.mark.parametrize(("size", "count"), [(1, 1_000), (128, 5_000), (100_000, 20)])
def test_a_body_of_other_chunks_is_read(port, size, count):
    assert port.send(chunked(size, count), until_closed=False).error["field"] == "body"


@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        ("NONSENSE\r\n\r\n", 400, "illegal request line"),
        ("GET /healthz HTTP/1.1\r\n\r\n", 400, "Missing mandatory Host"),
        (POST + "Content-Length: 2\r\nContent-Length: 3\r\n\r\n{}", 400, "conflicting Content-Length"),
        (POST + "Transfer-Encoding: gzip\r\n\r\n{}", 501, "Only Transfer-Encoding: chunked"),
        (POST + "Transfer-Encoding: chunked\r\n\r\nzz\r\n", 400, "illegal chunk header"),
        (b"GET /\xff HTTP/1.1\r\nHost: x\r\n\r\n", 400, "illegal request line"),
        (b"GET / HTTP/1.1\r\nHost: x\r\nX: ".ljust((1 << 16) + 1, b"a"), 431, "too long"),
    ],
)
def test_bytes_that_are_no_request_get_an_error_of_the_usual_form(port, request_, status, words):
    answer = port.send(request_)
    assert answer.status == status
    assert words in answer.error["message"]
    assert "NONSENSE" not in answer.error["message"], "nothing of the request is repeated"
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["connection"] == "close"
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_nonsense_behind_a_request_that_is_being_answered_ends_the_connection(port, caplog):
    with caplog.at_level(logging.ERROR):
        answer = port.send("GET /metrics HTTP/1.1\r\nHost: {host}\r\n\r\nNONSENSE\r\n\r\n")
    assert answer.status == 200
    assert caplog.messages == []


@pytest.mark.parametrize(
    "path", ["/healthz", "/readyz", "/metrics", "/v1/info", "/v1/sessions", "/v1/sessions/none", "/openapi.json"]
)
def test_head_has_the_head_of_get(port, http, path):
    head = port.send(f"HEAD {path} HTTP/1.1\r\nHost: {{host}}\r\n\r\n", until_closed=False)
    get = http.get(path)
    assert head.status == get.status_code
    assert head.headers["content-type"] == get.headers["content-type"]
    assert (path == "/metrics") or head.headers["content-length"] == get.headers["content-length"]
    assert "HEAD" in http.put("/healthz").headers["allow"].split(", ")


@pytest.mark.parametrize(
    ("method", "path", "field", "words"),
    [
        ("GET", "/v1/sessions?page_siz=3", "page_siz", "did you mean page_size?"),
        ("GET", "/v1/sessions?sates=idle", "sates", "did you mean states or state?"),
        ("GET", "/v1/sessions?page_size=3&page_size=4", "page_size", "one value, got 2"),
        ("GET", "/v1/sessions?labels=a=1&label=a=2", "labels", "one value of each key, got two of 'a'"),
        ("GET", "/v1/sessions?" + "q" * 500 + "=1", "q" * 80, "one of page_size"),
        ("GET", "/v1/sessions?a%0Ab=1", "a\\nb", "one of page_size"),
        ("GET", "/v1/sessions/some?veiw=full", "veiw", "did you mean view?"),
        ("GET", "/v1/sessions/some/history?form=2020-01-01", "form", "did you mean from?"),
        ("GET", "/v1/sessions/some/history?start=2020-01-01", "start", "did you mean start_time"),
        ("GET", "/v1/sessions/some/statistics?x=1", "x", "expected no parameters"),
        ("GET", "/v1/sessions/some/snapshot?x=1", "x", "expected no parameters"),
        ("GET", "/v1/info?x=1", "x", "expected no parameters"),
        ("POST", "/v1/sessions?session_id=some", "session_id", "expected no parameters"),
        ("POST", "/v1/sessions/some:reset?x=1", "x", "expected no parameters"),
        ("POST", "/v1/sessions:restore?sesion_id=some", "sesion_id", "did you mean session_id"),
        ("PATCH", "/v1/sessions/some?mask=labels", "mask", "one of update_mask"),
        ("DELETE", "/v1/sessions/some?force=true", "force", "expected no parameters"),
    ],
)
def test_an_unknown_parameter_is_refused_by_its_name(http, method, path, field, words):
    answer = http.request(method, path)
    assert answer.status_code == 422
    assert answer.json()["error"]["field"] == field
    assert words in answer.json()["error"]["message"]


@pytest.mark.parametrize("path", ["/a%0Ab%1B[31m", "/v1/sessions/some/a%0Ab", "/" + "a" * 9_000])
def test_an_address_of_nothing_is_named_in_a_line(http, path):
    message = http.get(path).json()["error"]["message"]
    assert message.isprintable()
    assert len(message) < 120


def test_probes_may_add_parameters(http):
    assert http.get("/healthz?at=17").status_code == 200
    assert http.get("/metrics?name[]=up").status_code == 200


@pytest.mark.parametrize("token", ["garbage", "0", "-1-x", "1-2-3", "9" * 40 + "-0123456789abcdef-some", "%00"])
def test_a_token_of_no_page_is_refused(http, token):
    error = http.get(f"/v1/sessions?page_token={token}").json()["error"]
    assert (error["name"], error["field"]) == ("InvalidArgument", "page_token")


def test_a_token_belongs_to_its_filter():
    listed = pb.ListSessionsRequest(states=[1, 2], labels={"a": "1", "b": "2"}, page_size=3)
    last = Position(1_700_000_000_123_456, "shirt-1")
    token = page_token(listed, last)
    same = pb.ListSessionsRequest(states=[2, 1], labels={"b": "2", "a": "1"}, page_size=9, page_token=token)
    assert position_after(same) == last
    for change in ({"states": [1]}, {"labels": {"a": "1"}}, {"labels": {"a": "1", "b": "3"}}, {}):
        with pytest.raises(InvalidArgument, match="page_token: expected a token of the same states and labels"):
            position_after(pb.ListSessionsRequest(page_token=token, **change))


@pytest.mark.parametrize("path", ["/v1/sessions/", "/v1/meshes/", "/v1/info/", "/docs/"])
def test_a_slash_at_the_end_is_another_address(http, path):
    """A redirection would answer a call of a session without an id with the list of sessions."""
    answer = http.get(path)
    assert (answer.status_code, answer.json()["error"]["name"]) == (404, "NotFound")

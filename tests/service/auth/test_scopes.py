"""Scopes: every call of every transport needs a key, and the key a sufficient scope."""

from __future__ import annotations

import json

import grpc
import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import PermissionDenied, Unauthenticated, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from ddakf_service.auth.guard import GRPC_SCOPES, STREAM
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect as websocket

from ..conftest import TIMEOUT, running
from .conftest import METHODS, call

GUARDED = [name for name in METHODS if name != "GetServerInfo"]


@pytest.mark.parametrize("method", GUARDED)
def test_no_method_of_grpc_works_without_a_key_or_with_a_wrong_one(guarded, method):
    assert isinstance(call(guarded, method, None), Unauthenticated)
    assert isinstance(call(guarded, method, "ddakf_0123456789ab_" + 43 * "A"), Unauthenticated)
    assert isinstance(call(guarded, method, "nonsense"), Unauthenticated)


@pytest.mark.parametrize("method", GUARDED)
def test_a_method_of_grpc_needs_its_scope(guarded, method):
    refused = call(guarded, method, guarded.keys["read"])
    assert isinstance(refused, PermissionDenied) == (GRPC_SCOPES["/ddakf_api.v1.TrackingService/" + method] == STREAM)
    assert not isinstance(call(guarded, method, guarded.keys["admin"]), (PermissionDenied, Unauthenticated))


def test_reflection_needs_a_key_but_health_and_the_handshake_do_not(guarded):
    with grpc.insecure_channel(guarded.grpc) as channel:
        assert health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest()).status
        assert rpc.TrackingServiceStub(channel).GetServerInfo(pb.GetServerInfoRequest(api_version=API_VERSION)).server_version
        reflection = reflection_pb2_grpc.ServerReflectionStub(channel)
        with pytest.raises(grpc.RpcError) as refused:
            list(reflection.ServerReflectionInfo(iter([reflection_pb2.ServerReflectionRequest(list_services="")])))
    assert isinstance(from_rpc_error(refused.value), Unauthenticated)


def routes(service) -> list[tuple[str, str]]:
    """Method and path of every documented operation that is not open."""
    document = httpx.get(service.http + "/openapi.json").json()
    open_paths = ("/healthz", "/readyz", "/v1/info")
    return [
        (method.upper(), path.replace("{session_id}", "nobody"))
        for path, operations in document["paths"].items()
        for method in operations
        if path not in open_paths
    ]


def test_no_route_works_without_a_key_or_without_its_scope(guarded):
    found = routes(guarded)
    assert {"GET", "POST", "DELETE"} <= {method for method, _ in found}
    with httpx.Client(base_url=guarded.http, timeout=TIMEOUT) as http:
        for method, path in found:
            answer = http.request(method, path)
            assert answer.status_code == 401, (method, path)
            assert answer.json()["error"]["name"] == "Unauthenticated"
            assert answer.headers["www-authenticate"] == "Bearer"
            needs_stream = method != "GET" or path.endswith("/snapshot") or "/meshes" in path
            for key, refused in (("read", needs_stream), ("stream", path in ("/metrics", "/v1/recording"))):
                headers = {"authorization": f"Bearer {guarded.keys[key]}"}
                assert (http.request(method, path, headers=headers).status_code == 403) == refused, (method, path, key)


def test_what_says_whether_the_service_lives_is_open(guarded):
    for path in ("/", "/healthz", "/readyz", "/v1/info", "/openapi.json"):
        assert httpx.get(guarded.http + path).status_code == 200, path


def test_unknown_paths_are_closed(guarded):
    assert httpx.get(guarded.http + "/v1/anything").status_code == 401
    headers = {"authorization": f"Bearer {guarded.keys['read']}"}
    assert httpx.get(guarded.http + "/v1/anything", headers=headers).status_code == 403


@pytest.mark.parametrize("what", ["stream", "watch"])
def test_a_websocket_is_refused_before_it_opens(guarded, what):
    address = guarded.http.replace("http", "ws") + f"/v1/sessions/nobody/{what}"
    with pytest.raises(InvalidStatus) as refused, websocket(address, proxy=None):
        pass
    assert refused.value.response.status_code == 401
    assert json.loads(refused.value.response.body)["error"]["name"] == "Unauthenticated"
    named = ["ddakf.v1", f"ddakf.key.{guarded.keys['read']}"]
    if what == "stream":
        with pytest.raises(InvalidStatus) as refused, websocket(address, proxy=None, subprotocols=named):
            pass
        assert refused.value.response.status_code == 403
        return
    with websocket(address, proxy=None, subprotocols=named) as connection:
        assert connection.subprotocol == "ddakf.v1"


@pytest.mark.slow
def test_without_keys_only_loopback_is_served(tmp_path):
    with running(["--host", "0.0.0.0", "--workers", "1"], tmp_path) as service:
        assert isinstance(call(service, "ListSessions", None), Unauthenticated)
    assert "ddakf keys create" in (tmp_path / "service.log").read_text()


def test_a_line_feed_at_the_end_of_a_path_does_not_change_its_scope(guarded):
    headers = {"authorization": f"Bearer {guarded.keys['read']}"}
    for path in ("/v1/sessions/nobody/snapshot", "/v1/sessions/nobody/snapshot%0A", "/v1/sessions/nobody/snapshot/%0A"):
        assert httpx.get(guarded.http + path, headers=headers).status_code == 403, path


def test_a_refused_call_of_grpc_is_not_read(guarded):
    """A call without a key is rejected for that before its oversized request has arrived."""
    sent = bytes(65 << 20)
    with grpc.insecure_channel(guarded.grpc) as channel:
        for kind, request in ((channel.unary_unary, sent), (channel.stream_stream, iter([sent]))):
            method = "CreateSession" if request is sent else "Track"
            with pytest.raises(grpc.RpcError) as refused:
                list(kind(f"/ddakf_api.v1.TrackingService/{method}")(request, timeout=TIMEOUT))
            assert isinstance(from_rpc_error(refused.value), Unauthenticated), method


@pytest.mark.slow
def test_on_loopback_a_key_is_asked_of_whom_a_proxy_forwards_and_of_names_that_point_here(service):
    port = service.http.rsplit(":", 1)[1]
    for headers, status in (
        ({}, 200),
        ({"host": f"localhost:{port}"}, 200),
        ({"host": f"[::1]:{port}"}, 200),
        ({"host": f"rebound.example:{port}"}, 401),
        ({"host": "127.0.0.1.example"}, 401),
        ({"x-forwarded-for": "192.0.2.1"}, 401),
        ({"forwarded": "for=192.0.2.1"}, 401),
    ):
        assert httpx.get(service.http + "/v1/sessions", headers=headers).status_code == status, headers
        assert httpx.get(service.http + "/healthz", headers=headers).status_code == 200, headers
    with grpc.insecure_channel(service.grpc) as channel:
        list_sessions = rpc.TrackingServiceStub(channel).ListSessions
        list_sessions(pb.ListSessionsRequest(), timeout=TIMEOUT)
        with pytest.raises(grpc.RpcError) as refused:
            list_sessions(pb.ListSessionsRequest(), timeout=TIMEOUT, metadata=(("x-forwarded-for", "192.0.2.1"),))
    assert isinstance(from_rpc_error(refused.value), Unauthenticated)

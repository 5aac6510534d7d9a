"""Operations: health, readiness, reflection, metrics, OpenAPI, limits."""

from __future__ import annotations

from pathlib import Path

import grpc
import pytest
from ddakf_api import API_VERSION
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.tracing import STAGES
from google.protobuf import descriptor_pb2, json_format
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from prometheus_client.parser import text_string_to_metric_families

from ..conftest import TIMEOUT, frame_of, request_of


def samples(http) -> dict[tuple, float]:
    families = text_string_to_metric_families(http.get("/metrics").text)
    return {(s.name, *sorted(s.labels.values())): s.value for family in families for s in family.samples}


def test_health_over_grpc(api):
    stub = health_pb2_grpc.HealthStub(api.channel)
    services = ("grpc.health.v1.Health", "grpc.reflection.v1alpha.ServerReflection")
    for name in ("", "ddakf_api.v1.TrackingService", *services):
        answer = stub.Check(health_pb2.HealthCheckRequest(service=name), timeout=TIMEOUT)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING
    with pytest.raises(grpc.RpcError) as unknown:
        stub.Check(health_pb2.HealthCheckRequest(service="other"), timeout=TIMEOUT)
    assert unknown.value.code() is grpc.StatusCode.NOT_FOUND


def test_reflection_lists_the_service(api):
    stub = reflection_pb2_grpc.ServerReflectionStub(api.channel)
    requests = iter([reflection_pb2.ServerReflectionRequest(list_services="")])
    (answer,) = stub.ServerReflectionInfo(requests, timeout=TIMEOUT)
    names = {service.name for service in answer.list_services_response.service}
    assert {"ddakf_api.v1.TrackingService", "grpc.health.v1.Health"} <= names
    requests = iter([reflection_pb2.ServerReflectionRequest(file_containing_symbol="ddakf_api.v1.TrackingService")])
    (answer,) = stub.ServerReflectionInfo(requests, timeout=TIMEOUT)
    files = [descriptor_pb2.FileDescriptorProto.FromString(f) for f in answer.file_descriptor_response.file_descriptor_proto]
    methods = {method.name for file in files for service in file.service for method in service.method}
    assert methods == set(pb.DESCRIPTOR.services_by_name["TrackingService"].methods_by_name)


def test_health_and_readiness_over_rest(http):
    assert http.get("/healthz").json() == {"status": "ok"}
    assert http.get("/readyz").json() == {"status": "ready", "problems": []}


def test_both_sides_tell_the_same_about_the_server(api, http, client):
    over_grpc = api.call("GetServerInfo", pb.GetServerInfoRequest(api_version="77.0"))
    over_rest = json_format.Parse(http.get("/v1/info").text, pb.ServerInfo())
    assert over_grpc == over_rest
    assert (over_rest.api_version, over_rest.max_limits.max_points) == (API_VERSION, 500_000)
    assert client.server.codecs == ("raw", "quantised", "morton-zstd", "morton-deflate", "draco")
    assert client.server.depth_codecs == ("none", "zstd", "png", "rvl")
    assert "cotton" in over_rest.fabrics


def test_metrics_follow_the_frames(api, http, session, sheet):
    before = samples(http)
    spoilt = frame_of(sheet, 3)
    spoilt.point_cloud.data = b"?"
    late = frame_of(sheet, 4)
    late.deadline = 1e-9
    list(api.track(session, [request_of(f) for f in (frame_of(sheet, 1), frame_of(sheet, 2), spoilt, late)]))
    after = samples(http)

    def grown(*key):
        return after[key] - before.get(key, 0)

    assert grown("ddakf_frames_total", "applied") == 2
    assert grown("ddakf_frames_total", "rejected") == 1
    assert grown("ddakf_frames_total", "late") == 1
    assert grown("ddakf_frame_seconds_count", "lossless", "morton_zstd") == 2
    assert grown("ddakf_frame_reliability_count") == 2
    for stage in ("queue", "decode", *STAGES, "encode", "total"):
        assert grown("ddakf_frame_stage_seconds_count", *sorted(("lossless", "morton_zstd", stage))) == 2
    assert after["ddakf_sessions",] >= 1
    assert after["ddakf_workers_ready",] == after["ddakf_workers",] == 2


def test_dropped_frames_are_counted(api, http, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(max_frame_rate=2.0)).name
    before = samples(http)["ddakf_frames_total", "dropped"]
    list(api.track(name, [request_of(frame_of(sheet, i)) for i in range(1, 21)], pb.FLOW_MODE_REALTIME))
    dropped = api.get(name).statistics.frames_dropped
    assert samples(http)["ddakf_frames_total", "dropped"] - before == dropped > 0
    api.delete(name)


def test_the_documented_metrics_are_those_that_are_exported(http):
    """Names, types and labels, both ways; except Prometheus' own process metrics."""
    text = (Path(__file__).parents[3] / "docs/operations.md").read_text()
    table = text.partition("<!-- metrics: begin -->")[2].partition("<!-- metrics: end -->")[0]
    documented = {}
    for line in table.strip().splitlines()[2:]:
        name, kind, labels, meaning = (cell.strip() for cell in line.strip("|").split("|"))
        documented[name.strip("`").removesuffix("_total")] = kind, {x.strip() for x in labels.split(",") if x}, meaning
    families = {f.name: f for f in text_string_to_metric_families(http.get("/metrics").text) if not f.name.startswith("process_")}
    assert set(documented) == set(families)
    for name, (kind, labels, meaning) in documented.items():
        assert (kind, meaning) == (families[name].type, families[name].documentation)
        for sample in families[name].samples:
            assert set(sample.labels) - {"le"} == labels, name


def test_metrics_never_name_a_session(api, http, session, sheet):
    list(api.track(session, [request_of(frame_of(sheet, 1))]))
    assert session.removeprefix("sessions/") not in http.get("/metrics").text


def test_unknown_pages_answer_like_errors(http):
    answer = http.get("/v1/nothing")
    assert answer.status_code == 404
    assert answer.json()["error"]["message"]


def test_a_full_server_says_when_to_come_back(api, http, sheet):
    names = []
    body = {"garment": {"vertices": sheet.vertices.tolist(), "faces": sheet.faces.tolist()}}
    try:
        while len(names) <= 64:
            answer = http.post("/v1/sessions", json=body)
            if answer.status_code != 201:
                break
            names.append(answer.json()["name"])
        assert answer.status_code == 429
        assert int(answer.headers["retry-after"]) >= 1
        assert "64" in answer.json()["error"]["message"]
    finally:
        for name in names:
            api.delete(name)

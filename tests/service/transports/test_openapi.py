"""OpenAPI document: complete and correct, with examples that run against the server."""

from __future__ import annotations

import itertools
import json
import socket

import httpx
import jsonschema
import pytest
import schemathesis
from ddakf_service.transports.rest.requests import EXAMPLE_ID
from hypothesis import HealthCheck, given, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi import checks

import ddakf

from ..conftest import TIMEOUT, frame_of, request_of

OCTETS = "application/octet-stream"
UNSET = "/v1/recording"  # of a setting that the tests' service does not have
CHECKS = [
    not_a_server_error,
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_schema_conformance,
    checks.response_headers_conformance,
    checks.unsupported_method,
]


@pytest.fixture(scope="module")
def document(service):
    return httpx.get(f"{service.http}/openapi.json").json()


@pytest.fixture
def left_as_it_was(http):
    """Deletes the sessions that a test has created."""
    before = names(http)
    yield
    for name in names(http) - before:
        http.delete(f"/v1/{name}")


def names(http) -> set[str]:
    return {session["name"] for session in http.get("/v1/sessions", params={"page_size": 1000}).json()["sessions"]}


def operations(document: dict):
    """(path, method, operation), creation first, deletion last."""
    found = [(path, method, op) for path, methods in document["paths"].items() for method, op in methods.items()]
    return sorted(found, key=lambda item: (item[1] == "delete", item[0] != "/v1/sessions", item[1] != "post"))


def examples(operation: dict, place: str):
    """The combinations of the examples of an operation's parameters in a place."""
    parameters = [p for p in operation.get("parameters", []) if p["in"] == place and "examples" in p]
    values = [[example["value"] for example in p["examples"].values()] for p in parameters]
    return [dict(zip([p["name"] for p in parameters], chosen, strict=True)) for chosen in itertools.product(*values)]


def resolved(document: dict, schema: dict) -> dict:
    return {**schema, "components": document["components"]}


def test_every_operation_is_described(document):
    assert len(document["paths"]) >= 10
    for path, method, operation in operations(document):
        assert operation["description"], (path, method)
        for parameter in operation.get("parameters", []):
            assert parameter.get("description") or parameter["schema"].get("description") or "enum" in parameter["schema"]
        if "{session_id}" in path:
            assert {"404", "410"} <= set(operation["responses"]), (path, method)
            assert examples(operation, "path"), (path, method)
        if method in ("post", "patch"):
            assert operation["requestBody"]["content"], (path, method)


def test_every_example_runs(http, document, left_as_it_was):
    snapshot, ran = None, 0
    for path, method, operation in operations(document):
        assert http.get("/healthz").status_code == 200
        content = operation.get("requestBody", {}).get("content", {"": {}})
        ((kind, body),) = content.items()
        for where, query, value in itertools.product(
            examples(operation, "path"), examples(operation, "query"), list(body.get("examples", {"": {"value": None}}).values())
        ):
            if kind == OCTETS:
                snapshot = snapshot or http.get(f"/v1/sessions/{EXAMPLE_ID}/snapshot").content
                answer = http.request(method, path, params=query, content=snapshot)
            else:
                sent = {"json": value["value"]} if kind else {}
                answer = http.request(method, path.format(**where), params=query, **sent)
            assert answer.is_success or (path == UNSET and answer.status_code == 404), (method, path, answer.text)
            response = operation["responses"][str(answer.status_code)]
            if "application/json" in response.get("content", {}):
                schema = response["content"]["application/json"]["schema"]
                jsonschema.validate(answer.json(), resolved(document, schema))
            ran += 1
    assert ran >= len(document["paths"])


def test_a_snapshot_travels_over_http_bit_for_bit(http, api, session, sheet):
    answer = http.get(f"/v1/{session}/snapshot")
    assert answer.headers["content-type"] == OCTETS
    assert answer.headers["ddakf-last-sequence-number"] == str(api.get(session).statistics.last_sequence_number)
    params = {"session_id": "copy-of-it", "label": ["a=b", "c=d=e"], "max_points": 7, "idle_timeout": 20}
    created = http.post("/v1/sessions:restore", params=params, content=answer.content)
    assert created.status_code == 201, created.text
    assert created.headers["location"] == "/v1/sessions/copy-of-it"
    assert created.json()["labels"] == {"a": "b", "c": "d=e"}
    assert (created.json()["limits"]["max_points"], created.json()["limits"]["idle_timeout"]) == (7, 20)
    assert http.get("/v1/sessions/copy-of-it/snapshot").content == answer.content
    assert http.post("/v1/sessions:restore", content=b"no snapshot").json()["error"]["name"] == "InvalidSnapshot"
    api.delete("sessions/copy-of-it")


def test_another_method_is_refused_with_those_there_are(http, session):
    for path, methods in (
        ("/v1/sessions", "GET, HEAD, POST"),
        (f"/v1/{session}", "DELETE, GET, HEAD, PATCH"),
        (f"/v1/{session}:reset", "POST"),
        ("/v1/sessions:restore", "POST"),
    ):
        answer = http.put(path)
        assert (answer.status_code, answer.headers["allow"]) == (405, methods), path
        assert answer.json()["error"]["name"] == "MethodNotAllowed"
    assert http.get(f"/v1/{session}:reset").status_code == 405


def test_an_upload_above_the_limit_is_refused_by_its_length(http):
    """The error comes before the body, which is never sent."""
    head = f"POST /v1/sessions:restore HTTP/1.1\r\nHost: localhost\r\nContent-Length: {1 << 40}\r\n\r\n"
    with socket.create_connection((http.base_url.host, http.base_url.port), timeout=TIMEOUT) as connection:
        connection.sendall(head.encode())
        answer = connection.recv(1 << 16)
    assert answer.startswith(b"HTTP/1.1 413 ")


def test_patch_changes_what_the_mask_says(http, session):
    url = f"/v1/{session}"
    first = http.patch(url, json={"labels": {"a": "b"}, "limits": {"max_points": 9}}).json()
    assert (first["labels"], first["limits"]["max_points"]) == ({"a": "b"}, 9)
    second = http.patch(url, params={"update_mask": "limits"}, json={"labels": {"x": "y"}, "limits": {"max_points": 8}}).json()
    assert (second["labels"], second["limits"]["max_points"]) == ({"a": "b"}, 8)
    assert second["etag"] != first["etag"]
    third = http.patch(url, params={"update_mask": "labels"}, json={}).json()
    assert (third["labels"], third["limits"]["max_points"]) == ({}, 8)
    assert http.patch(url, json={"labels": {}, "etag": third["etag"]}).status_code == 200
    assert http.patch(url, json={"labels": {}, "etag": first["etag"]}).json()["error"]["name"] == "FailedPrecondition"
    assert http.patch(url, json={"fabric": "silk"}).json()["fabric"] == "silk"
    refused = http.patch(url, params={"update_mask": "labels,colour"}, json={})
    assert (refused.status_code, refused.json()["error"]["field"]) == (422, "update_mask")
    assert http.patch("/v1/sessions/nobody", json={}).status_code == 404


def test_null_in_a_patch_is_absent(http, session):
    url = f"/v1/{session}"
    http.patch(url, json={"labels": {"a": "b"}})
    changed = http.patch(url, json={"session": {"fabric": "silk", "labels": None, "limits": None}}).json()
    assert (changed["fabric"], changed["labels"]) == ("silk", {"a": "b"})


def test_an_answer_can_be_changed_and_sent_back(http, session):
    url = f"/v1/{session}"
    answer = http.get(url).json()
    changed = http.patch(url, json={"session": {**answer, "labels": {"a": "b"}}})
    assert changed.status_code == 200, changed.text
    follow = {"labels", "etag", "expire_time", "checkpoint_time"}  # the change and the clock
    assert changed.json()["labels"] == {"a": "b"}
    assert {k: v for k, v in changed.json().items() if k not in follow} == {k: v for k, v in answer.items() if k not in follow}
    refused = http.patch(url, json={"session": {**answer, "body_mesh": "meshes/some"}}).json()["error"]
    assert refused["message"] == "body_mesh: expected no mesh, as a session keeps those of its creation, got a mesh"


def test_a_listed_session_that_is_sent_back_keeps_its_configuration(http, session):
    url = f"/v1/{session}"
    before = http.patch(url, json={"config_json": '{"associate": {"wide_gate": 0.05}}'}).json()
    sessions = http.get("/v1/sessions", params={"page_size": 1000}).json()["sessions"]
    (listed,) = (each for each in sessions if each["name"] == session)
    changed = http.patch(url, json={"session": {**listed, "labels": {"a": "b"}}}).json()
    assert (changed["labels"], changed["config_json"]) == ({"a": "b"}, before["config_json"])
    reset = http.patch(url, params={"update_mask": "config_json"}, json={}).json()
    assert json.loads(reset["config_json"]) == ddakf.Config().to_dict()


@pytest.mark.parametrize("method", ["PATCH", "DELETE"])
def test_if_match_prevents_a_lost_update(http, api, sheet, method):
    name = api.create(sheet).name
    url, body = f"/v1/{name}", {"json": {"labels": {"a": "b"}}} if method == "PATCH" else {}
    etag = http.get(url).json()["etag"]
    present = http.patch(url, json={"labels": {"by": "another"}}).json()["etag"]
    for stale in (f'"{etag}"', etag, f'"{etag}", W/"{present}"', ""):
        refused = http.request(method, url, headers={"If-Match": stale}, **body)
        assert (refused.status_code, refused.json()["error"]["name"]) == (412, "FailedPrecondition"), stale
        assert refused.json()["error"]["message"].startswith(f'If-Match: expected "{present}", the etag of {name}, or *, got')
    assert http.get(url).json()["labels"] == {"by": "another"}
    assert http.request(method, url, headers={"If-Match": f'"0", "{present}"'}, **body).is_success
    last = http.request(method, url, headers={"If-Match": "*"}, **body)
    assert last.status_code == (200 if method == "PATCH" else 404)
    if method == "PATCH":
        api.delete(name)


def test_reset_over_http_starts_where_it_says(http, api, session, sheet):
    moved = (sheet.vertices + [0.3, 0, 0]).tolist()
    assert http.post(f"/v1/{session}:reset", json={"vertices": moved}).status_code == 200
    result = list(api.track(session, [request_of(frame_of(sheet, 1, shift=(0.3, 0, 0)))]))[-1].result
    assert result.coverage > 0.9
    assert http.get(f"/v1/{session}/statistics").json()["last_sequence_number"] == "1"
    assert http.post(f"/v1/{session}:reset").status_code == 200
    refused = http.post(f"/v1/{session}:reset", json={"vertices": moved[:3]})
    assert (refused.status_code, refused.json()["error"]["field"]) == (422, "vertices")


def test_arbitrary_requests_are_answered_as_the_document_says(service, left_as_it_was):
    schema = schemathesis.openapi.from_url(f"{service.http}/openapi.json")
    for found in schema.get_all_operations():

        @settings(max_examples=8, deadline=None, database=None, suppress_health_check=list(HealthCheck))
        @given(case=found.ok().as_strategy())
        def answered(case):
            case.call_and_validate(checks=CHECKS)

        answered()

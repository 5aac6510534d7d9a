"""The JSON of REST and WebSocket: the protobuf JSON mapping, and the earlier forms that the document lists."""

from __future__ import annotations

import json
import random
import re
from pathlib import Path

import pytest
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.transports.dialect import schema
from ddakf_service.transports.dialect.reading import read
from ddakf_service.transports.dialect.writing import as_json
from ddakf_service.transports.rest.requests import update_request
from google.protobuf import json_format
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message_factory import GetMessageClass

from ..conftest import frame_of, request_of
from .websockets_client import START, line

PROTOCOL = Path(__file__).resolve().parents[3] / "docs/protocol.md"
MESSAGES = {name: GetMessageClass(descriptor) for name, descriptor in pb.DESCRIPTOR.message_types_by_name.items()}
NUMBERS = {
    FieldDescriptor.CPPTYPE_UINT32: [0, 1, 2**32 - 1],
    FieldDescriptor.CPPTYPE_UINT64: [0, 7, 2**64 - 1],
    FieldDescriptor.CPPTYPE_DOUBLE: [0.0, -1.5, 1e300, float("inf")],
    FieldDescriptor.CPPTYPE_BOOL: [False, True],
}


def table() -> list[list[str]]:
    """Rows of the document: request, form, earlier form."""
    text = PROTOCOL.read_text().partition("<!-- dialect: begin -->")[2].partition("<!-- dialect: end -->")[0]
    return [re.findall(r"`([^`]+)`", row) for row in text.strip().splitlines()[2:]]


BODIES = [row for row in table() if not row[0].startswith("GET")]
QUERIES = [row for row in table() if row[0].startswith("GET")]


def some(descriptor, rng: random.Random):
    """A message with random values in about half of its fields."""
    message = GetMessageClass(descriptor)()
    for field in descriptor.fields:
        if rng.random() < 0.5 or (field.containing_oneof and message.WhichOneof(field.containing_oneof.name)):
            continue
        kind = field.message_type
        if kind is not None and kind.GetOptions().map_entry:
            number = kind.fields_by_name["value"].cpp_type != FieldDescriptor.CPPTYPE_STRING
            getattr(message, field.name)["ü."] = 0.5 if number else "x"
        elif kind is not None and kind.name == "Timestamp":
            getattr(message, field.name).FromNanoseconds(rng.randrange(2**60))
        elif kind is not None and kind.name == "FieldMask":
            getattr(message, field.name).paths.extend(["config_json", "limits"])
        elif kind is not None:
            values = [some(kind, rng) for _ in range(2)]
            getattr(message, field.name).extend(values) if field.is_repeated else getattr(message, field.name).CopyFrom(values[0])
        else:
            values = [one(field, rng) for _ in range(2)]
            getattr(message, field.name).extend(values) if field.is_repeated else setattr(message, field.name, values[0])
    return message


def one(field, rng: random.Random):
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return rng.choice(field.enum_type.values).number
    if field.type == FieldDescriptor.TYPE_BYTES:
        return rng.randbytes(rng.randrange(9))
    return rng.choice(NUMBERS.get(field.cpp_type, ["", "té"]))


@pytest.mark.parametrize("name", MESSAGES)
def test_every_message_is_read_as_the_mapping_writes_it(name):
    for seed in range(20):
        message = some(MESSAGES[name].DESCRIPTOR, random.Random(seed))
        for options in ({}, {"preserving_proto_field_name": True}, {"use_integers_for_enums": True}):
            assert read(json_format.MessageToJson(message, **options), MESSAGES[name]) == message
        assert read(as_json(message), MESSAGES[name]) == json_format.Parse(as_json(message), MESSAGES[name]()) == message


@pytest.mark.parametrize(("request_name", "form", "earlier"), BODIES)
def test_a_form_of_the_document_and_its_earlier_form_are_one_request(request_name, form, earlier):
    kind = MESSAGES[request_name]
    assert read(form, kind) == read(earlier, kind) == json_format.Parse(form, kind())
    assert read(form, kind) != kind()
    if kind is pb.UpdateSessionRequest:
        assert update_request(form.encode(), "sessions/a", "") == update_request(earlier.encode(), "sessions/a", "")


@pytest.mark.parametrize(("address", "form", "earlier"), QUERIES)
def test_a_query_of_the_document_and_its_earlier_form_have_one_answer(http, api, sheet, address, form, earlier):
    name, other = api.create(sheet, labels={"a": "b"}).name, api.create(sheet, labels={"a": "c"}).name
    path = address.removeprefix("GET ").format(id=name.removeprefix("sessions/"))
    answers = [http.get(path + query) for query in (form, earlier, "")]
    assert [answer.status_code for answer in answers] == [200] * 3
    texts = [re.sub(r'"(expire|checkpoint)_time": "[^"]+",? ?', "", answer.text) for answer in answers]  # these follow the clock
    assert texts[0] == texts[1]
    assert texts[2] != texts[0] or "history" in path, "the query is heeded"
    for each in (name, other):
        api.delete(each)


def test_answers_of_rest_are_those_of_grpc_in_the_mapping(http, api, session, sheet):
    list(api.track(session, [request_of(frame_of(sheet, 1))]))
    full = pb.GetSessionRequest(name=session, view=pb.SESSION_VIEW_FULL)
    for path, method, request, kind in (
        ("info", "GetServerInfo", pb.GetServerInfoRequest(), pb.ServerInfo),
        (f"{session}?view=SESSION_VIEW_FULL", "GetSession", full, pb.Session),
        (f"{session}/history", "GetSessionHistory", pb.GetSessionHistoryRequest(name=session), pb.SessionHistory),
        ("sessions?page_size=1", "ListSessions", pb.ListSessionsRequest(page_size=1), pb.ListSessionsResponse),
    ):
        over_rest = json_format.Parse(http.get(f"/v1/{path}").text, kind())
        over_grpc = api.call(method, request)
        for answer in (over_rest, over_grpc):
            for found in (answer, *getattr(answer, "sessions", ())):
                if isinstance(found, pb.Session):
                    found.ClearField("expire_time")  # and the frame rate: both follow the clock
                    found.statistics.ClearField("frame_rate")
        assert over_rest == over_grpc, path


def test_errors_have_the_fields_of_their_message(http):
    answer = http.get("/v1/nothing/here").json()
    assert answer["error"]["name"] == "NotFound"
    assert set(answer["error"]) == set(pb.ErrorDetail.DESCRIPTOR.fields_by_name)


@pytest.mark.parametrize(
    ("kind", "text", "field", "words"),
    [
        ("Start", '{"colour": 1}', "colour", "no field of this name, got 1"),
        ("Start", '{"flow_mode": "fast"}', "flow_mode", "FLOW_MODE_REALTIME or FLOW_MODE_LOSSLESS"),
        ("Start", '{"flow_mode": "\\udfff"}', "flow_mode", "FLOW_MODE_REALTIME or FLOW_MODE_LOSSLESS"),
        ("Start", '{"flow_mode": "FLOW_MODE_LOSSLESS\\u0000"}', "flow_mode", "FLOW_MODE_REALTIME or FLOW_MODE_LOSSLESS"),
        ("ResetSessionRequest", '{"vertices": {"encoding": "\\ud800"}}', "vertices.encoding", "ARRAY_ENCODING_FLOAT64"),
        ("Start", '{"takeover": 1}', "takeover", "true or false"),
        ("Start", '{"name": "\\ud800"}', "name", "UTF-8"),
        ("Start", '{"result_options": []}', "result_options", "an object, got []"),
        ("Start", "[" * 100_000, "body", "a Start as JSON"),
        ("Start", "NaN", "body", "an object"),
        ("Start", "9" * 9_000, "body", "a Start as JSON"),
        ("TrackRequest", '{"ping": {"token": -1}}', "ping.token", "at least 0, got -1"),
        ("TrackRequest", '{"ping": {"token": "many"}}', "ping.token", "an integer"),
        ("TrackRequest", '{"ping": {"token": 1.5}}', "ping.token", "an integer"),
        ("TrackRequest", '{"ping": {}, "start": {}}', "start", "nothing beside ping"),
        ("TrackRequest", '{"frame": {"deadline": true}}', "frame.deadline", "a number"),
        ("TrackRequest", '{"frame": {"sensors": {}}}', "frame.sensors", "a list"),
        ("TrackRequest", '{"frame": {"body_vertices": "?"}}', "frame.body_vertices", "base64"),
        ("GetSessionHistoryRequest", '{"start_time": "soon"}', "start_time", "a time"),
        ("Session", '{"labels": {"a": 1}}', "labels.a", "a string"),
        ("Session", '{"a\\nb": 1}', "a\\nb", "no field of this name"),
        ("Session", '{"a\\u001b[31m": "\\u009b\\u2028"}', "a\\x1b[31m", '"\\x9b\\u2028"'),
        ("Session", '{"' + "a" * 9_000 + '": 1}', "a" * 80, "no field of this name"),
        ("Session", '{"labels": {"a\\nb": 1}}', "labels.a\\nb", "a string"),
        ("Session", '{"labels": ["' + "a" * 9_000 + '"]}', "labels", "an object"),
    ],
)
def test_an_invalid_value_is_refused_with_its_field(kind, text, field, words):
    with pytest.raises(InvalidArgument) as refused:
        read(text, MESSAGES[kind])
    assert refused.value.field == field
    assert words in str(refused.value)
    assert len(str(refused.value)) < 300
    str(refused.value).encode()
    assert str(refused.value).isprintable()


def test_a_deep_configuration_is_text_or_refused():
    for depth in range(900, 1010):
        try:
            assert read('{"config": ' + '{"a":' * depth + "1" + "}" * (depth + 1), pb.Session).config_json
        except InvalidArgument as error:
            assert error.field == "body"  # noqa: PT017


def test_every_field_of_the_contract_has_its_line_in_the_schema_file():
    names = {f"{name}.{field.name}" for name, kind in MESSAGES.items() for field in kind.DESCRIPTOR.fields}
    assert names <= set(schema.comments())
    assert schema.comments()["Session.labels"] == "Free key-value pairs of the client, for filters and display."


def test_the_schema_of_a_message_is_that_of_its_json():
    import jsonschema

    components = schema.schemas(*MESSAGES.values())
    for name, kind in MESSAGES.items():
        for seed in range(5):
            written = json.loads(as_json(some(kind.DESCRIPTOR, random.Random(seed))))
            jsonschema.validate(written, {**schema.reference(kind), "components": {"schemas": components}})
            assert set(written) <= set(components[name]["properties"])


def test_a_websocket_to_no_session_closes_before_anything_is_sent(service):
    for place in ("stream", "watch?api_version=1.0"):
        with line(service, f"sessions/nobody/{place}") as websocket:
            assert websocket.ending() == (4404, "there is no session 'sessions/nobody'")


@pytest.mark.parametrize("mode", ["binary", "json"])
def test_a_missing_version_is_named(service, session, mode):
    start = pb.TrackRequest()
    start.CopyFrom(START)
    start.start.ClearField("api_version")
    with line(service, f"{session}/stream", mode) as websocket:
        websocket.send(start)
        code, reason = websocket.ending()
    assert (code, reason.partition(":")[0]) == (4400, "api_version")
    with line(service, f"{session}/watch", mode) as websocket:
        assert websocket.ending()[1].startswith("api_version: ")

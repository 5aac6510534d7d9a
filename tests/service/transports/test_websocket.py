"""Streams and watchers over WebSocket, in binary and in text frames."""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path
from typing import NamedTuple

import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import ERRORS
from ddakf_api.v1 import tracking_pb2 as pb
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from ..conftest import TIMEOUT, frame_of, held, make_sheet, request_of, workers
from .websockets_client import START, Line, handshake, line

ROOT = Path(__file__).resolve().parents[3]


def without_timings(responses) -> list[pb.TrackResponse]:
    for response in responses:
        if response.HasField("result"):
            response.result.ClearField("timings")
            response.result.ClearField("usage")
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


@pytest.mark.parametrize("mode", ["binary", "json"])
def test_a_watcher_sees_the_clients_frames(service, api, session, sheet, mode):
    frame = frame_of(sheet, 1)
    with line(service, f"{session}/watch?api_version=1.0&include_frames=true", mode) as watcher:
        assert watcher.receive().started.name == session
        _, answer = api.track(session, [request_of(frame)])
        assert watcher.receive() == pb.TrackResponse(frame=frame)
        assert watcher.receive() == answer


def test_a_watcher_is_told_the_end_and_only_reads(service, api, sheet):
    name = api.create(sheet).name
    with line(service, f"{name}/watch?api_version=1.0") as watcher, line(service, f"{name}/watch?api_version=1.0") as other:
        assert (watcher.receive(), other.receive()) != (None, None)
        other.send(START)
        assert other.ending() == (4409, "a watcher only reads")
        api.delete(name)
        assert watcher.ending() == (4404, f"{name} was deleted")
    for query in ("every_nth=often", "include_frames=some"):
        with line(service, f"{name}/watch?api_version=1.0&{query}") as refused:
            assert refused.ending()[0] == 4422


class Wrong(NamedTuple):
    """A client's messages, and the end of its stream."""

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
    "a long name of lines": Wrong(
        [pb.TrackRequest(start=pb.Start(name="a\nb\x1b" * 300_000)).SerializeToString()], 4422, r"got a\nb\x1ba"
    ),
    "start twice": Wrong([START.SerializeToString()] * 2, 4422, "a frame or a ping, got start"),
    # the frame, in a worker that is held, keeps the stream from its end until the message after it has come
    "more after the end": Wrong([START.SerializeToString(), FRAME, b"", b""], 4409, "no message may follow"),
    "a long sentence": Wrong([START.SerializeToString()], 4422, "...", query="mode=" + "é" * 60),
}


@pytest.mark.parametrize("mode", ["binary", "json"])
@pytest.mark.parametrize(("path", "name"), [("sessions/nobody", "SessionNotFound"), ("", "SessionBusy")])
def test_the_error_that_ends_a_stream_comes_whole_before_the_close_code(service, session, mode, path, name):
    """Several errors have the status of one close code, 409, and its reason holds no more than a sentence."""
    with line(service, f"{session}/stream") as first:
        first.send(START)
        assert first.receive().started.name == session
        with line(service, f"{path or session}/stream", mode) as refused:
            with contextlib.suppress(ConnectionClosed):  # it ends at once where there is no session
                refused.send(START)
            error = refused.receive().error
            code, reason = refused.ending()
    assert (error.name, error.message) == (name, reason)
    assert code == 4000 + ERRORS[name].http_status


@pytest.mark.parametrize("case", WRONG)
def test_a_stream_that_ends_with_an_error_says_why_in_its_close_code(service, session, case):
    wrong = WRONG[case]
    url = f"{service.http.replace('http', 'ws', 1)}/v1/{wrong.path or session}/stream?{wrong.query}"
    with connect(url, proxy=None, open_timeout=TIMEOUT, max_size=1 << 10) as connection:
        with contextlib.suppress(ConnectionClosed), held(workers(service.pid)):
            for message in wrong.send:
                connection.send(message)
        code, reason = Line(connection, "").ending()
    assert code == wrong.code, reason
    assert wrong.words in reason
    assert len(reason.encode()) <= 123
    assert reason.isprintable()


def test_a_stream_is_taken_over_across_transports(service, api, session, sheet):
    with line(service, f"{session}/stream") as first:
        first.send(START)
        assert first.receive().started.name == session
        with line(service, f"{session}/stream") as second:
            second.send(START)
            assert second.ending()[0] == 4409
        list(api.track(session, [request_of(frame_of(sheet, 1))], takeover=True))
        code, reason = first.ending()
    assert (code, reason) == (4409, f"another stream took over {session}")


def test_text_that_is_no_utf8_is_refused_in_a_sentence(service, session):
    with handshake(service, f"{session}/stream") as client:
        client.sendall(b"\x01\x81\0\0\0\0a" + b"\x80\x82\0\0\0\0\xff\xfe")
        received = b"".join(iter(lambda: client.recv(1 << 16), b""))
    assert received.endswith(b"\x03\xefmessage: expected text in UTF-8, got invalid start byte at byte 1")


MASKED = b"\x80\0\0\0\0"  # no payload


@pytest.mark.parametrize(
    ("first", "repeated"),
    [(b"", b"\x8a"), (b"", b"\x89"), (b"\x02" + MASKED, b"\0"), (b"\x82" + MASKED, b"\x82")],
    ids=["pongs", "pings", "fragments", "messages after the end"],
)
def test_a_flood_of_empty_frames_ends_its_connection(service, session, first, repeated):
    """Their number costs the time of all streams; messages, which flow control holds back, are none of them."""
    with handshake(service, f"{session}/stream") as flooding:
        with contextlib.suppress(ConnectionError):
            flooding.sendall(first + (repeated + MASKED) * 100_000)
        received = b""
        with contextlib.suppress(ConnectionError):
            while data := flooding.recv(1 << 16):
                received += data
    reason = b"has to be start" if repeated == b"\x82" else b"\x03\xf0more than 500 control frames or small fragments a second"
    assert reason in received


def test_a_client_of_many_pings_and_fragments_stays(service, session, sheet):
    """In one read they are more than the server parses at once."""
    start, frame = START.SerializeToString(), request_of(frame_of(sheet, 1)).SerializeToString()
    with line(service, f"{session}/stream") as websocket:
        for _ in range(100):
            websocket.connection.ping()
        websocket.connection.send([start[:1], b"", start[1:]])
        websocket.connection.send([frame[at : at + 128] for at in range(0, len(frame), 128)])
        for token in range(5_000):
            websocket.send(pb.TrackRequest(ping=pb.Ping(token=token)))
        websocket.send(None)
        kinds = []
        with contextlib.suppress(ConnectionClosed):
            while True:
                kinds.append(websocket.receive().WhichOneof("message"))
        assert websocket.connection.close_code == 1000
    assert (kinds[0], kinds.count("result"), kinds.count("pong")) == ("started", 1, 5_000)


def test_nothing_is_compressed(service, session):
    with line(service, f"{session}/stream") as websocket:
        assert websocket.connection.protocol.extensions == []


def test_the_recipe_for_a_browsers_console(service, http):
    """The commands of docs/protocol.md, sent by another WebSocket client."""
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

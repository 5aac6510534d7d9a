"""Overload: too many frames, late frames, unread responses; one worker, real sockets."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time

import grpc
import httpx
import pytest
from ddakf_api.errors import DeadlineExceeded, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from ddakf_client import Limits
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as connect_websocket

from ..conftest import TIMEOUT, Api, Talk, eventually, frame_of, held, is_free, make_sheet, request_of, running, workers

pytestmark = pytest.mark.slow

LARGE = make_sheet(50, 0.01)


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """A service of one worker with a short reader timeout."""
    arguments = ["--workers", "1", "--spare-workers", "0", "--reader-timeout", "1", "--request-timeout", "1"]
    with running(arguments, tmp_path_factory.mktemp("single")) as service:
        yield service


@pytest.fixture(scope="module")
def api(single):
    api = Api(single.grpc)
    with api.channel:
        yield api


def test_a_frame_whose_turn_comes_too_late_is_not_tracked(single, api, sheet):
    name = api.create(sheet).name
    answers = {}
    with Talk(api, name) as talk, held(workers(single.pid)):
        for number, deadline in ((1, 0.0), (2, 0.1), (3, 60.0)):
            frame = frame_of(sheet, number)
            frame.deadline = deadline
            talk.send(frame)
        talk.await_arrival()
        frame.sequence_number, frame.deadline = 4, -1.0
        talk.send(frame)
        time.sleep(0.2)  # twice as long as the second can wait
    for response in talk.answers:
        kind = response.WhichOneof("message")
        answers[getattr(response, kind).sequence_number] = getattr(response, kind)
    assert answers[2].error.name == "DeadlineExceeded"
    assert answers[2].frames_late == 1
    assert (answers[4].error.name, answers[4].error.field) == ("InvalidFrame", "deadline")
    assert (answers[3].frames_applied, answers[3].frames_late, answers[3].frames_rejected) == (2, 1, 0)
    assert answers[4].frames_rejected == 1
    statistics = api.get(name).statistics
    assert (statistics.frames_applied, statistics.frames_late, statistics.frames_rejected) == (2, 1, 1)
    api.delete(name)


def test_frames_beyond_a_realtime_sessions_rate_are_dropped_and_the_client_is_told_once(api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(max_frame_rate=2.0)).name
    responses = list(api.track(name, [request_of(frame_of(sheet, i)) for i in range(1, 31)], pb.FLOW_MODE_REALTIME))
    notices = [response.notice for response in responses if response.HasField("notice")]
    assert [(notice.kind, notice.value) for notice in notices] == [(pb.NOTICE_KIND_SLOW_DOWN, 2.0)]
    assert responses[-1].result.sequence_number == 30
    statistics = api.get(name).statistics
    assert statistics.frames_applied + statistics.frames_dropped == 30
    assert statistics.frames_dropped > 20
    api.delete(name)


def test_a_client_far_beyond_a_realtime_sessions_rate_never_waits_in_vain(client, sheet):
    """It may have eight unanswered frames, and all of them may be dropped."""

    def camera():
        for number in range(1, 61):
            time.sleep(0.005)
            yield sheet.vertices, number / 30

    with client.create_session(*sheet, limits=Limits(max_frame_rate=8.0)) as session:
        answers = list(session.track(camera(), timeout=20.0, on_notice=lambda _: None))
    assert answers[-1].sequence == 60
    assert answers[-1].applied + answers[-1].dropped == 60


def test_a_stream_that_ends_while_a_frame_waits_for_its_rate_counts_the_frame_as_dropped(api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(max_frame_rate=0.01)).name
    with Talk(api, name, flow=pb.FLOW_MODE_REALTIME) as talk:
        assert talk.ask(frame_of(sheet, 1))[-1].HasField("result")
        talk.send(frame_of(sheet, 2))
        talk.await_arrival()
        list(api.track(name, [], takeover=True))
    statistics = api.get(name).statistics
    assert (statistics.frames_applied, statistics.frames_dropped) == (1, 1)
    api.delete(name)


def test_frames_beyond_a_lossless_sessions_rate_are_held_back(api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(max_frame_rate=20.0)).name
    begun = time.monotonic()
    responses = list(api.track(name, [request_of(frame_of(sheet, i)) for i in range(1, 13)]))
    assert time.monotonic() - begun > 9 / 20
    assert [response.result.sequence_number for response in responses[1:]] == list(range(1, 13))
    api.delete(name)


def test_who_sends_more_than_can_be_tracked_is_told_how_much_can_be(single, api, sheet):
    name = api.create(sheet).name

    def too_many():
        for number in range(1, 200):
            time.sleep(0.01)
            yield request_of(frame_of(sheet, number))

    stream = api.track(name, too_many(), pb.FLOW_MODE_REALTIME)
    assert next(stream).HasField("started")
    for _ in range(3):
        assert next(response for response in stream if response.HasField("result"))
    notices = (response.notice for response in stream if response.HasField("notice"))
    with held(workers(single.pid)):
        told = next(notices)
    assert told.kind == pb.NOTICE_KIND_SLOW_DOWN
    assert 0 < told.value < 300
    assert list(notices) == []
    api.delete(name)


def test_a_greedy_session_starves_no_other_of_its_worker(api, sheet):
    """Both sessions have all their frames ready; while the modest one has its twenty tracked, the greedy one gets few more."""
    greedy, modest = api.create(LARGE).name, api.create(sheet).name
    counts, at_the_end = {greedy: 0, modest: 0}, {}

    def run(name, sheet, count):
        for response in api.track(name, [request_of(frame_of(sheet, i)) for i in range(1, count + 1)]):
            counts[name] += response.HasField("result")
        at_the_end[name] = dict(counts)

    threads = [threading.Thread(target=run, args=args) for args in ((greedy, LARGE, 90), (modest, sheet, 20))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(TIMEOUT)
    assert at_the_end[modest][greedy] <= 45
    assert at_the_end[greedy] == {greedy: 90, modest: 20}
    for name in (greedy, modest):
        api.delete(name)


def test_a_stream_that_never_starts_ends(single):
    stub = rpc.TrackingServiceStub(grpc.insecure_channel(single.grpc))
    with pytest.raises(grpc.RpcError) as caught:
        list(stub.Track(iter(queue.Queue().get, None)))
    assert isinstance(from_rpc_error(caught.value), DeadlineExceeded)


ALL = pb.ResultOptions(include_covariance=True, include_velocities=True, vertex_encoding=pb.ARRAY_ENCODING_FLOAT64)


def test_a_reader_that_stalls_loses_its_stream_and_nobody_elses(single, api, sheet):
    """Its unread responses fill the connection and the stream ends; the worker serves the others throughout."""
    stalled, other = api.create(LARGE).name, api.create(sheet).name
    start = pb.TrackRequest(start=pb.Start(name=stalled, api_version="1.0", flow_mode=pb.FLOW_MODE_LOSSLESS, result_options=ALL))

    def requests():
        yield start
        for number in range(1, 2000):
            yield request_of(frame_of(LARGE, number))

    channel = grpc.insecure_channel(single.grpc, [("grpc.use_local_subchannel_pool", 1)])
    unread = rpc.TrackingServiceStub(channel).Track(requests())
    next(unread)
    for number in range(1, 21):
        assert list(api.track(other, [request_of(frame_of(sheet, number))]))[-1].result.frames_applied == number
    eventually(lambda: is_free(api, stalled))
    statistics = api.get(stalled).statistics
    assert 0 < statistics.frames_applied < 1999
    answered = []
    with pytest.raises(grpc.RpcError) as caught:
        answered.extend(response.result.sequence_number for response in unread)
    assert isinstance(from_rpc_error(caught.value), DeadlineExceeded)
    channel.close()
    last = statistics.last_sequence_number
    assert last == statistics.frames_applied > len(answered), "some were tracked whose answers it did not get"
    again = [request_of(frame_of(LARGE, number)) for number in (last, last + 1)]
    started, refused, result = api.track(stalled, again)
    assert started.started.last_sequence_number == last
    assert refused.frame_error.error.field == "sequence_number"
    assert result.result.sequence_number == last + 1
    for name in (stalled, other):
        api.delete(name)


def test_a_websocket_reader_that_stalls_loses_its_stream(single, api):
    name = api.create(LARGE).name
    url = single.http.replace("http", "ws", 1) + f"/v1/{name}/stream"
    narrow = socket.create_connection(tuple(single.http.removeprefix("http://").split(":")))
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    start = pb.Start(name=name, api_version="1.0", flow_mode=pb.FLOW_MODE_LOSSLESS, result_options=ALL)
    with connect_websocket(url, sock=narrow, max_queue=1, compression=None, close_timeout=0.1) as websocket:
        websocket.send(pb.TrackRequest(start=start).SerializeToString())
        stop = threading.Event()

        def send():
            with contextlib.suppress(ConnectionClosed, OSError):  # the connection ends beneath the sender
                for number in range(1, 2000):
                    if stop.is_set():
                        return
                    websocket.send(request_of(frame_of(LARGE, number)).SerializeToString())

        threading.Thread(target=send, daemon=True).start()
        eventually(lambda: is_free(api, name), 40)
        stop.set()
    assert 0 < api.get(name).statistics.frames_applied < 1999
    api.delete(name)


def dripping(single, request: bytes) -> bytes:
    """All answers to a client that sends the start of a request and then single bytes."""
    answer = b""
    with socket.create_connection(tuple(single.http.removeprefix("http://").split(":")), TIMEOUT) as connection:
        connection.sendall(request)
        connection.settimeout(0.1)
        deadline = time.monotonic() + TIMEOUT
        while time.monotonic() < deadline:
            try:
                if not (part := connection.recv(4096)):
                    return answer
                answer += part
            except TimeoutError:
                with contextlib.suppress(OSError):  # cut just now
                    connection.sendall(b"x")
            except ConnectionResetError:
                return answer
    raise AssertionError("the connection was not cut")


def test_a_body_that_drips_is_refused_and_its_connection_cut(single, api):
    head = b"POST /v1/sessions HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\n\r\n"
    answer = dripping(single, head)
    assert answer.startswith(b"HTTP/1.1 504 ")
    assert b"DeadlineExceeded" in answer
    assert b"the body did not come within 1 s" in answer


@pytest.mark.parametrize(
    "begun",
    [
        b"",
        b"GET /healthz HTTP/1.1\r\nX-Long: ",
        b"DELETE /v1/sessions/none HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9999\r\n\r\n",
    ],
    ids=["nothing", "headers", "an answered request's body"],
)
def test_a_request_that_drips_loses_its_connection(single, api, begun):
    answer = dripping(single, begun)
    assert not answer or answer.startswith(b"HTTP/1.1 404 ")


def test_a_connection_that_is_kept_serves_one_request_after_the_other(single):
    with httpx.Client(base_url=single.http, timeout=TIMEOUT) as http:
        for _ in range(4):
            assert http.get("/healthz").status_code == 200
            time.sleep(0.6)

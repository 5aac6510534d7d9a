"""Resumed streams: after a lost connection and after a reconnect notice."""

import asyncio
import threading
import time

import grpc
import pytest
from ddakf_api import transport
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import aconnect, connect, errors

from .conftest import in_one_buffer
from .line import Line


@pytest.mark.parametrize("forget", [0, 3])
def test_a_stream_reconnects_without_losing_a_frame(outage, mesh, frames, forget):
    outage.service.delay = 0.01
    notices, sequences = [], []
    with connect(outage.target) as client, client.create_session(*mesh, flow="lossless") as session:
        for result in session.track(in_one_buffer(frames(40)), on_notice=notices.append):
            sequences.append(result.sequence)
            assert result.vertices[0, 0] == pytest.approx((result.sequence - 1) / 100, abs=0.001)
            if result.sequence in (10, 25):
                outage.strike(forget=forget)
    assert sequences == sorted(sequences)
    assert sequences[-1] == 40
    # frames that the server tracked, but could not answer, are not sent again
    tracked = {frame.sequence_number for frame in outage.service.frames}
    assert tracked == set(range(1, 41))
    assert [notice.kind for notice in notices] == ["resumed"] * 2
    assert all(notice.value <= forget for notice in notices)


def test_in_realtime_mode_only_the_newest_frame_is_sent_again(outage, mesh, frames):
    outage.service.delay = 0.01
    struck = threading.Event()

    def camera():
        for i, frame in enumerate(frames(100)):
            time.sleep(0.01)
            if i == 30:
                threading.Thread(target=outage.strike).start()
                struck.set()
            yield frame

    with connect(outage.target) as client, client.create_session(*mesh) as session:
        sequences = [result.sequence for result in session.track(camera(), on_notice=lambda _: None)]
    assert struck.is_set()
    assert sequences == sorted(set(sequences))
    assert sequences[-1] == 100


def test_a_connection_lost_for_too_long_is_an_error(outage, mesh, frames):
    with connect(outage.target) as client:
        session = client.create_session(*mesh, flow="lossless")
        stream = session.track(frames(1000), resume=0.5)
        next(stream)
        outage.server.stop(0).wait()
        with pytest.raises(errors.Unavailable):
            list(stream)
    outage.start()
    with connect(outage.target) as client:
        stream = client.open_session(session.session_id, flow="lossless").track(frames(1000), resume=0)
        next(stream)
        outage.server.stop(0).wait()
        with pytest.raises(errors.Unavailable):
            list(stream)


@pytest.fixture(params=["the network", "the server"])
def hanging(request, outage):
    """A line to a server, and a function after which connections are lost and attempts to reconnect hang for some seconds."""
    timers = []
    with Line(outage.target) as line:

        def hang(seconds):
            if request.param == "the network":
                line.mute = True
            else:
                outage.service.starts = False
            line.cut()
            timer = threading.Timer(seconds, end)
            timer.daemon = True
            timer.start()
            timers.append(timer)

        def end():
            line.mute, outage.service.starts = False, True
            line.cut()

        yield line, hang
        for timer in timers:
            timer.cancel()
        end()


def held(frames, struck):
    """The frames, of which those after the second one come once the connection is lost: no result is on its way before."""
    for k, frame in enumerate(frames):
        if k == 2:
            assert struck.wait(20)
        yield frame


def test_an_attempt_to_reconnect_that_hangs_gives_way_to_the_next_one(hanging, mesh, frames):
    line, hang = hanging
    sequences, struck = [], threading.Event()
    with connect(line.target) as client, client.create_session(*mesh, flow="lossless") as session:
        for result in session.track(held(frames(6), struck), timeout=1, on_notice=lambda _: None):
            sequences.append(result.sequence)
            if result.sequence == 2:
                hang(4)
                struck.set()
    assert sequences == [1, 2, 3, 4, 5, 6]


async def test_so_it_does_in_the_asynchronous_client(hanging, mesh, frames):
    line, hang = hanging
    sequences, struck = [], asyncio.Event()

    async def camera():
        for k, frame in enumerate(frames(6)):
            if k == 2:
                await asyncio.wait_for(struck.wait(), 20)
            yield frame

    async with aconnect(line.target) as client, client.create_session(*mesh, flow="lossless") as session:
        async for result in session.track(camera(), timeout=1, on_notice=lambda _: None):
            sequences.append(result.sequence)
            if result.sequence == 2:
                hang(4)
                struck.set()
    assert sequences == [1, 2, 3, 4, 5, 6]


def test_attempts_to_reconnect_that_hang_end_with_the_time_for_them(hanging, mesh, frames):
    line, hang = hanging
    with connect(line.target) as client:
        stream = client.create_session(*mesh, flow="lossless").track(frames(1000), resume=1, on_notice=lambda _: None)
        next(stream)
        hang(8)
        begun = time.monotonic()
        with pytest.raises(errors.Unavailable):
            list(stream)
        assert time.monotonic() - begun < 6


async def test_so_they_do_in_the_asynchronous_client(hanging, mesh, frames):
    line, hang = hanging
    async with aconnect(line.target) as client:
        session = await client.create_session(*mesh, flow="lossless")
        stream = session.track(frames(1000), resume=1, on_notice=lambda _: None)
        await anext(stream)
        hang(8)
        begun = time.monotonic()
        with pytest.raises(errors.Unavailable):
            [_ async for _ in stream]
        assert time.monotonic() - begun < 6


DETECTION = transport.CLIENT_KEEPALIVE_SECONDS + transport.CLIENT_KEEPALIVE_TIMEOUT_SECONDS


def test_a_connection_that_falls_silent_without_an_end_is_resumed(outage, mesh, frames):
    """The network vanishes from under the open connection, and is there for a new one."""
    notices, sequences = [], []
    with Line(outage.target) as line, connect(line.target) as client, client.create_session(*mesh, flow="lossless") as session:
        for result in session.track(frames(20), on_notice=notices.append):
            sequences.append(result.sequence)
            if result.sequence == 5:
                line.freeze()
                begun = time.monotonic()
            elif len(notices) == 1:
                assert time.monotonic() - begun < DETECTION + 2
                notices.append(None)
    assert sequences == list(range(1, 21))
    assert notices[0].kind == "resumed"


async def test_so_it_is_in_the_asynchronous_client(outage, mesh, frames):
    notices, sequences = [], []
    with Line(outage.target) as line:
        async with aconnect(line.target) as client, client.create_session(*mesh, flow="lossless") as session:
            async for result in session.track(frames(20), on_notice=notices.append):
                sequences.append(result.sequence)
                if result.sequence == 5:
                    line.freeze()
    assert sequences == list(range(1, 21))
    assert [notice.kind for notice in notices] == ["resumed"]


def test_a_session_lost_in_the_outage_is_an_error(outage, mesh, frames):
    with connect(outage.target) as client:
        stream = client.create_session(*mesh, flow="lossless").track(frames(1000))
        next(stream)
        outage.service.sessions.clear()
        outage.strike(0)
        with pytest.raises(errors.SessionNotFound):
            list(stream)


def test_a_reconnect_notice_redirects_the_client(outage, service, mesh, frames):
    """The other server has the session and has tracked its first two frames."""
    with connect(outage.target) as client:
        session = client.create_session(*mesh, flow="lossless")
        service.answered = outage.service.answered
        moved = service.sessions[session.name] = pb.Session()
        moved.CopyFrom(outage.service.sessions[session.name])
        moved.statistics.last_sequence_number = 2
        outage.service.drains_at = 3
        outage.service.notice = pb.Notice(kind=pb.NOTICE_KIND_RECONNECT, message="elsewhere", target=service.target)
        sequences = [result.sequence for result in session.track(frames(6), on_notice=lambda _: None)]
        assert client.target == service.target
        assert session.info().applied == 4
    assert sequences == [1, 2, 3, 4, 5, 6]


def test_one_connection_per_server_for_repeated_redirects(outage, service, monkeypatch):
    """Every stream of a client receives the notice."""
    opened, open_channel = [], grpc.insecure_channel
    monkeypatch.setattr(grpc, "insecure_channel", lambda target, options: opened.append(target) or open_channel(target, options))
    with connect(outage.target) as client:
        for target in (service.target, service.target, outage.target, service.target):
            client.move(target)
            assert client.server_info()
    assert opened == [outage.target, service.target]

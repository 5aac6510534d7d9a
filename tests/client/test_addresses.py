"""Several addresses: the client uses the first server that answers, and the next one when it is lost, stops or refuses."""

import grpc
import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import aconnect, connect, errors
from ports import lasting_port

from . import fake_server


@pytest.fixture
def pair():
    """Two services with the same sessions and answers; each stops with ``stop``."""
    services = fake_server.FakeService(), fake_server.FakeService()
    services[1].sessions, services[1].answered = services[0].sessions, services[0].answered
    servers = []
    for service in services:
        server, service.target = fake_server.start(service)
        service.stop = lambda server=server: server.stop(0).wait()
        servers.append(server)
    yield services
    for server in servers:
        server.stop(0).wait()


def nobody() -> str:
    return f"127.0.0.1:{lasting_port()}"


def redirection(target: str) -> pb.Notice:
    return pb.Notice(kind=pb.NOTICE_KIND_RECONNECT, message="elsewhere", target=target)


@pytest.mark.parametrize("as_text", [False, True])
def test_the_first_that_answers_is_used(service, as_text):
    addresses = [nobody(), service.target, nobody()]
    with connect(", ".join(addresses) if as_text else addresses) as client:
        assert client.target == service.target


async def test_the_asynchronous_client_does_the_same(service):
    async with aconnect([nobody(), service.target]) as client:
        assert client.target == service.target


def test_none_that_answers_is_an_error_that_names_the_last():
    addresses = [nobody(), nobody()]
    with pytest.raises(errors.Unavailable, match=addresses[1]):
        connect(addresses)


@pytest.mark.parametrize("addresses", [[], "", "host", "one:7701,", ["one:7701", "two"], "one:7701,http://two:7702"])
def test_an_address_without_a_port_is_refused(addresses):
    with pytest.raises(errors.InvalidArgument) as refused:
        connect(addresses)
    assert refused.value.field == "target"


def test_a_call_goes_to_the_next_server_when_one_is_lost(pair, mesh):
    one, two = pair
    with connect([one.target, two.target]) as client:
        session = client.create_session(*mesh)
        one.stop()
        assert session.info().name == session.name
        assert client.target == two.target
        session.delete()
    assert not two.sessions


def test_an_answer_of_the_server_is_no_reason_to_go_elsewhere(pair, mesh):
    one, two = pair
    with connect([one.target, two.target]) as client:
        with pytest.raises(errors.SessionNotFound):
            client.open_session("some")
        assert client.target == one.target


def test_a_stream_goes_on_at_the_next_server(pair, mesh, frames):
    """The second server has the session as the first one left it, and repeats no answers."""
    one, two = pair
    two.answered = {}
    one.delay = two.delay = 0.005
    answered = []
    with connect([one.target, two.target]) as client, client.create_session(*mesh, flow="lossless") as session:
        for result in session.track(frames(30), on_notice=lambda _: None):
            answered.append(result.sequence)
            if result.sequence == 5:
                one.stop()
        assert client.target == two.target
    assert answered[-1] == 30
    assert answered == sorted(set(answered))
    tracked = [frame.sequence_number for frame in (*one.frames, *two.frames)]
    assert tracked == list(range(1, 31))


def test_a_server_that_falls_silent_is_left(pair, mesh, frames):
    """It holds its connections, as a vanished machine does."""
    one, two = pair
    one.silent_from = 4
    with connect([one.target, two.target], timeout=1.0) as client, client.create_session(*mesh, flow="lossless") as session:
        answered = [result.sequence for result in session.track(frames(8), on_notice=lambda _: None)]
        assert client.target == two.target
    assert answered[-1] == 8
    assert answered[:3] == [1, 2, 3]


async def test_an_asynchronous_client_leaves_it_too(pair, mesh, frames):
    one, two = pair
    one.silent_from = 4
    async with aconnect([one.target, two.target], timeout=1.0) as client:
        async with client.create_session(*mesh, flow="lossless") as session:
            answered = [result.sequence async for result in session.track(frames(8), on_notice=lambda _: None)]
        assert client.target == two.target
    assert answered[-1] == 8


async def test_an_asynchronous_stream_goes_on_at_the_next_server(pair, mesh, frames):
    one, two = pair
    one.drains_at = 3
    async with aconnect([one.target, two.target]) as client, client.create_session(*mesh, flow="lossless") as session:
        answered = [result.sequence async for result in session.track(frames(6), on_notice=lambda _: None)]
        assert client.target == two.target
    assert answered == [1, 2, 3, 4, 5, 6]


def test_a_redirection_wins_over_the_next_address(pair, service, mesh, frames):
    one, two = pair
    service.sessions, service.answered = one.sessions, one.answered
    one.drains_at = 3
    one.notice = redirection(service.target)
    with connect([one.target, two.target]) as client, client.create_session(*mesh, flow="lossless") as session:
        assert [result.sequence for result in session.track(frames(6), on_notice=lambda _: None)] == [1, 2, 3, 4, 5, 6]
        assert client.target == service.target


@pytest.fixture
def handover(pair):
    """Both services; the first one redirects its stream to the second one, which is slow, and drains at the third frame."""
    one, two = pair
    two.delay = 0.1
    one.drains_at, one.notice = 3, redirection(two.target)
    return one, two


@pytest.mark.parametrize("silent", [False, True])
def test_a_redirected_client_returns_to_its_only_address_when_the_other_server_is_lost(handover, mesh, frames, silent):
    one, two = handover
    two.silent_from = 5 if silent else 2**63
    answered = []
    with connect(one.target, timeout=1.0) as client, client.create_session(*mesh, flow="lossless") as session:
        for result in session.track(frames(8), on_notice=lambda _: None):
            answered.append(result.sequence)
            if result.sequence == 4:
                assert client.target == two.target
                one.drains_at = 2**63
                if not silent:
                    two.stop()
        assert client.target == one.target
    assert answered[-1] == 8


async def test_a_redirected_asynchronous_client_returns_too(handover, mesh, frames):
    one, two = handover
    answered = []
    async with aconnect(one.target) as client, client.create_session(*mesh, flow="lossless") as session:
        async for result in session.track(frames(8), on_notice=lambda _: None):
            answered.append(result.sequence)
            if result.sequence == 4:
                assert client.target == two.target
                one.drains_at = 2**63
                two.stop()
        assert client.target == one.target
    assert answered[-1] == 8


@pytest.mark.parametrize("act", ["call", "stream"])
def test_a_redirected_client_whose_server_was_lost_before_returns_too(pair, mesh, frames, act):
    one, two = pair
    with connect(one.target) as client, client.create_session(*mesh, flow="lossless") as session:
        client.move(two.target)
        two.stop()
        assert client.server_info() if act == "call" else len(list(session.track(frames(2)))) == 2
        assert client.target == one.target


@pytest.mark.parametrize("act", ["call", "stream"])
async def test_a_redirected_asynchronous_client_whose_server_was_lost_before_returns_too(pair, mesh, frames, act):
    one, two = pair
    async with aconnect(one.target) as client, client.create_session(*mesh, flow="lossless") as session:
        client.move(two.target)
        two.stop()
        assert await client.server_info() if act == "call" else len([_ async for _ in session.track(frames(2))]) == 2
        assert client.target == one.target


def test_a_stream_that_opens_nowhere_is_an_error_after_one_attempt_each(pair, mesh, frames):
    one, two = pair
    with connect([one.target, two.target]) as client:
        session = client.create_session(*mesh, flow="lossless")
        one.stop()
        two.stop()
        with pytest.raises(errors.Unavailable, match=two.target):
            list(session.track(frames(2)))


def test_a_successor_that_does_not_listen_yet_is_tried_again(service, mesh, frames):
    """It begins when the client has come back to the first server, which drains and tracks nothing more."""
    successor, port = fake_server.FakeService(), lasting_port()
    successor.sessions = service.sessions
    service.drains_at, service.notice = 3, redirection(f"127.0.0.1:{port}")
    started = []

    def begin(notice):
        if notice.kind == "resumed" and not started:
            started.append(fake_server.start(successor, port)[0])

    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        assert [result.sequence for result in session.track(frames(6), on_notice=begin)] == [1, 2, 3, 4, 5, 6]
        assert client.target == f"127.0.0.1:{port}"
    started[0].stop(0).wait()


def test_one_address_stays_one(service, monkeypatch):
    opened, open_channel = [], grpc.insecure_channel
    monkeypatch.setattr(grpc, "insecure_channel", lambda target, options: opened.append(target) or open_channel(target, options))
    with connect(service.target) as client:
        client.move_on(service.target)
        assert client.server_info()
    assert opened == [service.target]

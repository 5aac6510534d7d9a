"""The worker's end of the pipe: what it receives when the server closes."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
from ddakf_service.workers.messages.wire import BlockingChannel, Kind, Message, Spent, pack_error, unpack_error


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, BlockingChannel]]:
    """The server's end of a pipe, and the worker's."""
    server, worker = socket.socketpair()
    with server, worker:
        yield server, BlockingChannel(worker)


@pytest.mark.parametrize("number", [1, 2**32 - 1, 2**32, 2**63])
def test_requests_are_numbered_for_as_long_as_a_worker_lives(ends, number):
    server, channel = ends
    server.sendall(Message(Kind.CLOSE, number, "s-1").head())
    assert channel.receive().number == number


def test_receives_what_was_sent_before_the_server_closed(ends):
    server, channel = ends
    server.sendall(Message(Kind.CLOSE, 7, "s-1").head())
    server.close()
    assert channel.receive() == Message(Kind.CLOSE, 7, "s-1", b"")
    assert channel.receive() is None


def test_a_server_that_closed_with_an_answer_unread_is_gone(ends):
    server, channel = ends
    channel.send(Message(Kind.RESULT, 1, "s-1", b"never read"))
    server.close()
    assert channel.receive() is None


def test_a_message_that_was_cut_off_is_not_received(ends):
    server, channel = ends
    server.sendall(Message(Kind.RESET, 1, "s-1", b"content").head() + b"cont")
    server.close()
    assert channel.receive() is None


def test_an_error_tells_what_its_request_took():
    assert unpack_error(pack_error(b"detail", 0.25, 0.5)) == (b"detail", Spent(processor=0.25, busy=0.5))

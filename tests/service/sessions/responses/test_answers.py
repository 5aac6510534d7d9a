"""Answers: a client of a lossless stream gets each one once, however its connections and its server end."""

from __future__ import annotations

from collections import deque

from ddakf_api.errors import Unavailable
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client.exchange import Exchange, Plan
from ddakf_service.sessions.responses.answers import Answers
from ddakf_service.sessions.responses.response import Response
from hypothesis import example, given, settings
from hypothesis import strategies as st

CAPACITY = 3


def answer(number: int, *, refused: bool = False) -> Response:
    if refused:
        return Response(pb.TrackResponse(frame_error=pb.FrameError(sequence_number=number)))
    arrays = pb.Result(reliability=1).SerializeToString()
    return Response(pb.TrackResponse(result=pb.Result(sequence_number=number, coverage=0.5)), arrays)


class Server:
    """A session without tracker: what is tracked, answered, on the wire, and in the checkpoint."""

    def __init__(self):
        self.answers, self.last = Answers(), 0
        self.arrived, self.sent = deque(), deque()
        self.checkpoint = (0, [])

    def open(self, request: pb.TrackRequest) -> None:
        self.arrived.clear()
        repeated = []
        if request.start.HasField("answered_through"):
            repeated = self.answers.after(request.start.answered_through, self.last)
        started = pb.Started(last_sequence_number=self.last, max_frames_in_flight=CAPACITY, repeated_answers=len(repeated))
        self.sent = deque([Response(pb.TrackResponse(started=started)), *repeated])

    def track(self) -> None:
        if self.arrived:
            self.last = self.arrived.popleft()
            self._send(answer(self.last))

    def refuse(self) -> None:
        """Refuses the newest frame at its arrival, before those that wait."""
        if self.arrived:
            self._send(answer(self.arrived.pop(), refused=True))

    def _send(self, response: Response) -> None:
        self.answers.add(response, CAPACITY)
        self.sent.append(response)

    def lose_worker(self) -> None:
        self.last, _ = self.checkpoint

    def restart(self) -> None:
        self.last, serialised = self.checkpoint
        self.answers = Answers()
        self.answers.load(serialised)


class Client:
    """The client's state machine and what its caller got."""

    def __init__(self, server: Server):
        self.server, self.got = server, []
        self.exchange = Exchange(Plan("sessions/a", 10.0, flow="lossless", on_error="yield"), now=0.0)
        server.open(self.exchange.start_request(again=False))

    def send(self) -> None:
        if self.exchange.can_offer():
            self.exchange.offer(object(), 0.0)
        if self.exchange.can_take():
            self.server.arrived.append(self.exchange.take(0.0).sequence)

    def read(self) -> None:
        if self.server.sent:
            received = self.exchange.receive(self.server.sent.popleft().whole_message(), 0.0)
            self.got += [each.sequence for each in received if hasattr(each, "sequence")]

    def connect_again(self) -> None:
        if self.exchange.may_resume(Unavailable("cut"), 0.0):
            self.server.open(self.exchange.start_request(again=True))


STEPS = ["send", "send", "track", "track", "refuse", "read", "read", "checkpoint", "lose worker", "cut", "stop", "kill"]


@settings(max_examples=400, deadline=None)
@given(st.lists(st.sampled_from(STEPS), max_size=60))
@example(["send", "read", "send", "send", "refuse", "read", "send", "track", "track", "cut"])  # one repeated answer is known
def test_every_frame_is_answered_once(steps):
    server = Server()
    client = Client(server)
    for step in steps:
        if step == "send":
            client.send()
        elif step in ("track", "refuse", "lose worker"):
            getattr(server, step.replace(" ", "_"))()
        elif step == "read":
            client.read()
        elif step == "checkpoint":
            server.checkpoint = server.last, server.answers.serialised()
        else:
            if step == "stop":
                server.checkpoint = server.last, server.answers.serialised()
            if step != "cut":
                server.restart()
            client.connect_again()
    client.exchange.exhausted = True
    while server.sent or server.arrived or not client.exchange.is_done():
        if client.exchange.can_take():
            server.arrived.append(client.exchange.take(0.0).sequence)
        server.track()
        client.read()
    assert client.exchange.ended() == []
    assert sorted(client.got) == [*range(1, len(client.got) + 1)]


def test_the_oldest_answers_go():
    answers = Answers()
    for number in (1, 2, 3):
        answers.add(answer(number), 2)
    assert [each.sequence_number for each in answers.after(0, 9)] == [2, 3]


def test_answers_come_back_from_a_checkpoint_with_their_arrays():
    before, after = Answers(), Answers()
    before.add(answer(1), 4)
    before.add(answer(2, refused=True), 4)
    after.load(before.serialised())
    assert [each.whole_message() for each in after.after(0, 9)] == [each.whole_message() for each in before.after(0, 9)]
    assert after.after(0, 9)[0].whole_message().result.reliability == 1

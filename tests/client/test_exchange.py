"""Stream state machine: frames in flight, drops, refusals, deadlines and lost connections."""

import numpy as np
import pytest
from ddakf_api import errors
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame
from ddakf_client.exchange import IN_FLIGHT, Exchange, Plan
from hypothesis import given
from hypothesis import strategies as st


def opened(flow, window=0, last=0, timeout=10.0):
    exchange = Exchange(Plan("sessions/a", timeout, flow=flow, on_error="yield"), now=0.0)
    started = pb.Started(last_sequence_number=last, max_frames_in_flight=window)
    exchange.receive(pb.TrackResponse(started=started), 0.0)
    return exchange


def result(sequence):
    return pb.TrackResponse(result=pb.Result(sequence_number=sequence))


def refusal(sequence):
    return pb.TrackResponse(frame_error=pb.FrameError(sequence_number=sequence))


@pytest.mark.parametrize("flow", ["lossless", "realtime"])
@given(
    steps=st.lists(st.sampled_from(["offer", "take", "answer", "refuse", "drop"]), max_size=80),
    window=st.integers(0, 9),
)
def test_frames_in_flight_are_bounded_and_the_stream_never_deadlocks(flow, steps, window):
    exchange, at_server, sent, answered = opened(flow, window), [], 0, set()
    bound = min(window or IN_FLIGHT, IN_FLIGHT)

    def perform(step):
        nonlocal sent
        if step == "offer" and exchange.can_offer():
            exchange.offer(object(), 0.0)
        elif step == "take" and exchange.can_take():
            at_server.append(exchange.take(0.0).sequence)
            sent += 1
        elif step == "drop" and flow == "realtime" and len(at_server) > 1:
            del at_server[0]
        elif step in ("answer", "refuse") and at_server:
            sequence = at_server.pop(0)
            answered.add(sequence)
            exchange.receive(result(sequence) if step == "answer" else refusal(sequence), 0.0)

    for step in steps:
        perform(step)
        assert len(at_server) <= bound
    exchange.exhausted = True
    while not exchange.is_done() or at_server:
        perform("take")
        perform("answer")
    assert exchange.ended() == []
    if flow == "lossless":
        assert answered == set(range(1, sent + 1))


def test_realtime_replaces_the_waiting_frame_and_lossless_offers_none():
    exchange = opened("realtime", last=7)
    for name in "abc":
        exchange.offer(name, 0.0)
    taken = exchange.take(0.0)
    assert (taken.frame, taken.sequence) == ("c", 10)
    (answer,) = exchange.receive(result(10), 0.5)
    assert (answer.dropped, answer.latency) == (2, 0.5)

    exchange = opened("lossless")
    exchange.offer("a", 0.0)
    assert not exchange.can_offer()


def test_nothing_is_offered_before_the_stream_is_open():
    exchange = Exchange(Plan("sessions/a", 10.0), now=0.0)
    assert not exchange.can_offer()
    assert "the start of the stream" in str(exchange.overdue(0.0))


def test_the_deadline_runs_while_an_answer_is_owed_and_awaited():
    exchange = opened("lossless", timeout=2.0)
    exchange.reading(1.0)
    assert exchange.deadline(5.0) == 7.0  # nothing is owed
    exchange.offer("a", 5.0)
    exchange.take(6.0)
    assert exchange.deadline(6.5) == 8.0
    exchange.reading(None)
    assert exchange.deadline(6.5) == 8.5  # nobody waits
    exchange.reading(7.0)
    assert exchange.deadline(7.5) == 9.0
    exchange.receive(result(1), 7.5)
    exchange.exhausted = True
    exchange.finish(8.0)
    assert exchange.deadline(8.5) == 10.0  # the end is owed
    assert "the end of the stream" in str(exchange.overdue(0.0))


def test_a_frame_that_was_dropped_before_a_refused_one_is_owed_no_answer():
    exchange = opened("realtime", timeout=2.0)
    for _ in range(2):
        exchange.offer("a", 0.0)
        exchange.take(0.0)
    exchange.reading(0.0)
    exchange.receive(refusal(2), 1.0)
    assert exchange.deadline(5.0) == 7.0
    assert "frame" not in str(exchange.overdue(0.0))


def test_a_second_outage_has_as_long_to_end_and_a_flapping_one_has_not():
    exchange, lose = opened("lossless"), errors.Unavailable("lost")
    for second in (1.0, 60.0):
        assert exchange.may_resume(lose, second)
        exchange.pause(second)
        exchange.receive(pb.TrackResponse(started=pb.Started()), second + 0.5)
    assert exchange.may_resume(lose, 61.0)
    exchange.pause(61.0)
    assert exchange.may_resume(lose, 89.0)
    assert not exchange.may_resume(lose, 91.0)


def test_an_attempt_to_reconnect_has_the_timeout_and_no_longer_than_the_attempts_have():
    exchange, lose = opened("lossless", timeout=20.0), errors.Unavailable("lost")
    assert exchange.may_resume(lose, 1.0)
    begun = 1.0 + exchange.pause(1.0)
    exchange.reading(begun)
    assert exchange.deadline(begun) == begun + 20.0
    assert "the start of the stream" in str(exchange.overdue(begun + 20.0))
    assert exchange.may_resume(lose, 22.0)
    begun = 22.0 + exchange.pause(22.0)
    exchange.reading(begun)
    assert exchange.deadline(begun) == 31.0
    assert "within 30 s" in str(exchange.overdue(31.0))
    assert not exchange.may_resume(lose, 31.0)


def test_the_last_attempt_to_reconnect_begins_before_their_end():
    exchange, lose = opened("lossless"), errors.Unavailable("lost")
    assert exchange.may_resume(lose, 1.0)
    assert 30.5 + exchange.pause(30.5) <= 31.0


def test_an_end_with_frames_unanswered_or_unsent_is_an_error():
    exchange = opened("lossless")
    with pytest.raises(errors.Unavailable, match="before all frames were sent"):
        exchange.ended()
    exchange.offer("a", 0.0)
    exchange.take(0.0)
    exchange.exhausted = True
    with pytest.raises(errors.Unavailable, match="before it had answered frame 1"):
        exchange.ended()
    assert errors.Unavailable.retryable


def test_missing_arrays_of_a_result_are_empty():
    exchange = opened("lossless")
    exchange.offer("a", 0.0)
    exchange.take(0.0)
    (answer,) = exchange.receive(result(1), 0.0)
    assert answer.vertices.shape == (0, 3)
    assert answer.observed.dtype == np.bool_
    assert answer.state == "unspecified"


def test_frames_to_resend_survive_a_second_lost_connection():
    exchange = opened("lossless")
    for _ in range(3):
        exchange.offer(object(), 0.0)
        exchange.take(0.0)
    lose = errors.Unavailable("lost")
    sent = []
    for count in (1, 3):
        assert exchange.may_resume(lose, 1.0)
        exchange.receive(pb.TrackResponse(started=pb.Started(last_sequence_number=0)), 1.0)
        sent.append([exchange.take(1.0).sequence for _ in range(count)])
    assert sent == [[1], [1, 2, 3]]
    assert not exchange.can_take()


@pytest.mark.parametrize(
    ("frame", "seconds"), [(([[0, 0]], np.float32(0.5)), 0.5), (Frame(timestamp="now"), None), (object(), None), ((), None)]
)
def test_the_time_of_a_refused_frame_is_a_number_or_none(frame, seconds):
    exchange = opened("lossless")
    exchange.offer(frame, 0.0)
    exchange.refuse(exchange.take(0.0), errors.InvalidFrame("bad"))
    assert [refused.timestamp for refused in exchange.refused()] == [seconds]


def test_an_invalid_frame_is_refused_once_across_a_lost_connection():
    exchange = opened("lossless")
    exchange.offer(object(), 0.0)
    offered = exchange.take(0.0)
    assert exchange.may_resume(errors.Unavailable("lost"), 1.0)
    exchange.receive(pb.TrackResponse(started=pb.Started(last_sequence_number=0)), 1.0)
    exchange.refuse(offered, errors.InvalidFrame("bad"))
    exchange.refuse(exchange.take(1.0), errors.InvalidFrame("bad"))
    assert [refused.sequence for refused in exchange.refused()] == [1]


def test_an_invalid_frame_is_reported_after_a_lost_connection_too_once_those_before_it_are_answered():
    exchange, lose = opened("lossless"), errors.Unavailable("lost")
    for _ in range(2):
        exchange.offer(Frame(np.zeros((1, 3)), 0.0), 0.0)
        taken = exchange.take(0.0)
    assert exchange.refuse(taken, errors.InvalidFrame("no")) is None, "the answer to frame 1 will do"
    assert exchange.may_resume(lose, 1.0)
    answers = exchange.receive(pb.TrackResponse(started=pb.Started()), 1.0)
    assert [type(answer).__name__ for answer in answers] == ["Notice"]
    exchange.take(1.0)
    assert [answer.sequence for answer in exchange.receive(result(1), 1.0)] == [1, 2]

    exchange.offer(Frame(np.zeros((1, 3)), 0.0), 2.0)
    assert exchange.refuse(exchange.take(2.0), errors.InvalidFrame("no")).HasField("ping")
    assert exchange.may_resume(lose, 3.0)
    resumed, refused = exchange.receive(pb.TrackResponse(started=pb.Started(last_sequence_number=1)), 3.0)
    assert (resumed.kind, refused.sequence) == ("resumed", 3)

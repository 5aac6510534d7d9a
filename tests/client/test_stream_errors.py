"""Stream errors: failures of frames, source and server raise specific errors, never a hang."""

import itertools
import threading

import numpy as np
import pytest
from ddakf_client import Frame, FrameError, connect, errors

NAN = np.full((2, 3), np.nan)


def test_refused_frames_raise_or_are_yielded(service, mesh, frames):
    service.refused = {3}
    with connect(service.target) as client:
        session = client.create_session(*mesh, flow="lossless")
        with pytest.raises(errors.InvalidFrame, match="points: expected something else, got this") as refusal:
            list(session.track(frames(5)))
        assert refusal.value.sequence == 3
        with client.create_session(*mesh, flow="lossless") as session:
            answers = list(session.track(frames(5), on_error="yield"))
    assert [type(a).__name__ for a in answers] == ["Result", "Result", "FrameError", "Result", "Result"]
    assert answers[2].sequence == 3
    assert isinstance(answers[2].error, errors.InvalidFrame)


def test_frames_that_cannot_be_sent_raise_or_are_yielded(service, mesh, frames):
    made = frames(5)
    made[1] = (np.full((2, 3), np.nan), 0.5)
    made[3] = "a string"
    with connect(service.target) as client:
        session = client.create_session(*mesh, flow="lossless")
        with pytest.raises(errors.CodecError, match="finite") as refusal:
            list(session.track(made))
        assert refusal.value.sequence == 2
        with client.create_session(*mesh, flow="lossless") as session:
            answers = list(session.track(made, on_error="yield"))
    assert {a.sequence for a in answers if isinstance(a, FrameError)} == {2, 4}
    assert [a.sequence for a in answers] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("flow", ["lossless", "realtime"])
def test_a_frame_that_cannot_be_sent_is_refused_although_no_other_frame_comes(service, mesh, frames, flow):
    told = [threading.Event() for _ in range(5)]

    def source():
        for i, good in enumerate(frames(5)):
            yield (NAN, i / 30) if i in (1, 2) else good
            assert told[i].wait(10), f"frame {i + 1} has no answer"

    with connect(service.target) as client, client.create_session(*mesh, flow=flow) as session:
        answers = []
        for answer in session.track(source(), on_error="yield"):
            answers.append((answer.sequence, type(answer).__name__))
            told[answer.sequence - 1].set()
    assert answers == [(1, "Result"), (2, "FrameError"), (3, "FrameError"), (4, "Result"), (5, "Result")]


def test_frames_that_cannot_be_sent_are_refused_in_their_place_before_slower_answers(service, mesh, frames):
    """The frame after them is sent, and the last answers come only when they have been delivered."""
    service.silent_from, seen = 4, []
    made = [(NAN, i / 30) if i in (1, 2) else good for i, good in enumerate(frames(4))]
    with (
        connect(service.target) as client,
        client.create_session(*mesh, flow="lossless") as session,
        pytest.raises(errors.DeadlineExceeded, match="no answer to frame 4"),
    ):
        seen.extend(answer.sequence for answer in session.track(made, on_error="yield", timeout=1))
    assert seen == [1, 2, 3]


@pytest.mark.parametrize("by", ["client", "server"])
def test_frames_before_a_refused_one_are_answered_first(service, mesh, frames, by):
    made, service.delay, seen = frames(6), 0.05, []
    if by == "client":
        made[4] = (np.full((2, 3), np.nan), 0.5)
    else:
        service.refused = {5}
    with (
        connect(service.target) as client,
        client.create_session(*mesh, flow="lossless") as session,
        pytest.raises(errors.InvalidFrame) as refusal,
    ):
        seen.extend(answer.sequence for answer in session.track(made))
    assert seen[:4] == [1, 2, 3, 4]
    assert refusal.value.sequence == 5


def test_a_bad_frame_names_its_field_and_the_stream_goes_on(service, mesh, frames, bad_frame):
    made, (bad, field) = frames(3), bad_frame
    made[1] = bad
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        answers = list(session.track(made, on_error="yield"))
        with pytest.raises(errors.InvalidFrame, match=rf"^{field}: expected .*, got ") as refusal:
            list(session.track(made))
    refused = [a for a in answers if isinstance(a, FrameError)]
    assert [a.sequence for a in answers if not isinstance(a, FrameError)] == [1, 3]
    assert [(a.sequence, a.error.field, type(a.error)) for a in refused] == [(2, field, type(refusal.value))]
    assert refusal.value.field == field
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("error", [OSError("unplugged"), errors.InvalidFrame("of the camera"), SystemExit(3)])
@pytest.mark.parametrize("on_error", ["raise", "yield"])
def test_an_error_of_the_source_reaches_the_caller_unchanged(service, mesh, frames, error, on_error):
    def source():
        yield from frames(1)
        raise error

    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(type(error)) as raised:
            list(session.track(source(), on_error=on_error, timeout=3))
        assert raised.value is error
    assert service.sessions == {}


def test_frames_before_an_error_of_the_source_are_answered_first(service, mesh, frames):
    service.delay, seen = 0.02, []

    def source():
        yield from frames(10)
        raise OSError("unplugged")

    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(OSError, match="unplugged"):
            seen.extend(answer.sequence for answer in session.track(source()))
        assert seen == list(range(1, 11))
        assert session.info().applied == 10


def test_frames_before_an_error_of_the_source_survive_a_lost_connection(outage, mesh, frames):
    outage.service.delay, seen = 0.02, []

    def source():
        yield from frames(20)
        raise OSError("unplugged")

    with connect(outage.target) as client:
        stream = client.create_session(*mesh, flow="lossless").track(source(), on_notice=lambda _: None)
        seen.extend(answer.sequence for answer in itertools.islice(stream, 15))
        outage.strike()
        with pytest.raises(OSError, match="unplugged"):
            seen.extend(answer.sequence for answer in stream)
    assert seen == list(range(1, 21))


def test_all_frames_refused_in_realtime_do_not_stop_the_stream(service, mesh, frames):
    service.refused, service.delay = set(range(1, 100)), 0.002
    with connect(service.target) as client, client.create_session(*mesh) as session:
        answers = list(session.track(frames(99), on_error="yield", timeout=2))
    assert answers[-1].sequence == 99


def test_a_lost_worker_is_a_retryable_error(service, mesh, frames):
    service.lost_from = 3
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(errors.WorkerLost, match="was killed") as lost:
            list(session.track(frames(5)))
        assert lost.value.retryable
        assert lost.value.retry_after == 1.5


def test_a_silent_server_runs_into_the_timeout(service, mesh, frames):
    service.silent_from = 2
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(errors.DeadlineExceeded, match=r"no answer to frame 2 within 1 s"):
            list(session.track(frames(3), timeout=1))
        service.starts = False
        with pytest.raises(errors.DeadlineExceeded, match=r"no answer to the start of the stream within 1 s"):
            list(session.track(frames(3), timeout=1))


@pytest.mark.parametrize("flow", ["lossless", "realtime"])
def test_a_stream_that_ends_early_is_an_error(service, mesh, frames, flow):
    service.ends_at = 2
    with (
        connect(service.target) as client,
        client.create_session(*mesh, flow=flow) as session,
        pytest.raises(errors.Unavailable, match="the server ended the stream before"),
    ):
        list(session.track(frames(9)))


LARGE = np.random.default_rng(0).uniform(-1, 1, (20_000, 3))
DEPTH = {"depth": np.ones((200, 200), np.float32), "intrinsics": (200, 200, 100, 100)}


@pytest.mark.parametrize("limit_of", ["client", "server"])
@pytest.mark.parametrize("large", [Frame(LARGE, 1.0), Frame(timestamp=1.0, **DEPTH)], ids=["points", "depth"])
def test_a_frame_above_the_limit_is_refused_and_the_stream_goes_on(service, mesh, frames, large, limit_of):
    limits = {"max_message_bytes": 100_000} if limit_of == "client" else {}
    service.max_message_bytes = 0 if limits else 100_000
    service.delay, made, seen = 0.02, frames(6), []
    made[4] = large
    options = {"codec": "raw", "depth_codec": "none"}
    with connect(service.target, **limits) as client, client.create_session(*mesh, flow="lossless") as session:
        answers = list(session.track(made, on_error="yield", **options))
        with pytest.raises(errors.MessageTooLarge, match="expected a message of at most 100000 bytes") as refusal:
            seen.extend(answer.sequence for answer in session.track(made, **options))
    assert [type(answer).__name__ for answer in answers] == ["Result"] * 4 + ["FrameError", "Result"]
    assert type(answers[4].error) is errors.MessageTooLarge
    assert seen == [7, 8, 9, 10]
    assert refusal.value.sequence == 11
    assert refusal.value.field == ("points" if large.depth is None else "depth")
    assert not refusal.value.retryable


def test_a_request_above_the_limit_is_not_worth_a_retry(service, mesh):
    vertices = np.zeros((20_000, 3))
    with (
        connect(service.target, max_message_bytes=100_000) as client,
        pytest.raises(errors.MessageTooLarge, match="larger than max") as refusal,
    ):
        client.create_session(vertices, mesh[1])
    assert not refusal.value.retryable
    assert (refusal.value.expected, refusal.value.got.endswith(" bytes")) == ("at most 100000 bytes", True)

"""Lanes of a worker: no request holds up those of other sessions, and those of one session keep their order."""

from __future__ import annotations

import queue
import threading

import pytest
from ddakf_service.workers.compute.lanes import FRAMES, Lanes
from ddakf_service.workers.messages.wire import Kind, Message

PATIENCE = 30.0  # seconds


class Gate:
    """Answers requests; one whose content is "held" waits for its release, one that is "busy" computes until then."""

    def __init__(self):
        self.told: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self.released = threading.Event()
        self.at_a_time = self.most_at_a_time = 0
        self._counted = threading.Lock()
        self.lanes = Lanes(self._answer, self.told.put)

    def _answer(self, request: Message) -> Message:
        with self._counted:
            self.at_a_time += 1
            self.most_at_a_time = max(self.most_at_a_time, self.at_a_time)
        if request.content == b"held":
            assert self.released.wait(PATIENCE)
        while request.content == b"busy" and not self.released.is_set():
            pass
        with self._counted:
            self.at_a_time -= 1
        return Message(Kind.RESULT, request.number)

    def put(self, number: int, session_id: str, content: bytes = b"", kind: Kind = Kind.FRAME) -> None:
        self.lanes.put(Message(kind, number, session_id, content))

    def aside(self) -> int:
        """Number of the next request that has used its slice."""
        message = self.told.get(timeout=PATIENCE)
        assert message.kind is Kind.ASIDE
        return message.number

    def answered(self, count: int) -> list[int]:
        """Numbers of the next answers; on a busy machine any request may use its slice."""
        numbers = []
        while len(numbers) < count:
            message = self.told.get(timeout=PATIENCE)
            numbers += [message.number] if message.kind is Kind.RESULT else []
        return numbers


@pytest.fixture
def gate():
    gate = Gate()
    yield gate
    gate.released.set()


def test_a_costly_request_goes_on_aside_while_others_are_answered(gate):
    gate.put(1, "costly", b"held")
    for number in range(2, 6):
        gate.put(number, "cheap")
    assert gate.aside() == 1
    assert gate.answered(4) == [2, 3, 4, 5]
    gate.released.set()
    assert gate.answered(1) == [1]


@pytest.mark.parametrize("kind", [Kind.OPEN, Kind.IMPORT, Kind.RESTORE, Kind.CONFIGURE, Kind.HEAVY_FRAME])
def test_heavy_requests_hold_up_no_light_one_and_have_their_turns(gate, kind):
    gate.put(1, "one", b"held", kind)
    gate.put(2, "two", kind=kind)
    gate.put(3, "three")
    assert gate.answered(1) == [3]
    gate.released.set()
    assert gate.answered(2) == [1, 2]


def test_the_requests_of_a_session_keep_their_order_on_all_lanes(gate):
    kinds = (Kind.OPEN, Kind.FRAME, Kind.SNAPSHOT, Kind.HEAVY_FRAME, Kind.CONFIGURE, Kind.FRAME, Kind.CLOSE)
    gate.put(1, "one", b"held", kinds[0])
    for number, kind in enumerate(kinds[1:], 2):
        gate.put(number, "one", kind=kind)
    gate.released.set()
    assert gate.answered(len(kinds)) == list(range(1, len(kinds) + 1))


def test_few_requests_are_answered_at_a_time(gate):
    """Each takes the memory of a frame, or of a model."""
    kinds = (Kind.FRAME, Kind.HEAVY_FRAME, Kind.OPEN)
    for number in range(1, 10):
        gate.put(number, f"s{number}", b"held", kinds[number % 3])
    assert len({gate.aside() for _ in range(FRAMES + 1)}) == FRAMES + 1
    gate.released.set()
    assert sorted(gate.answered(9)) == list(range(1, 10))
    assert gate.most_at_a_time == FRAMES + 1


@pytest.mark.parametrize("content", [b"held", b"busy"])
def test_a_turn_ends_whether_a_request_waits_or_computes(gate, content, monkeypatch):
    if content == b"busy":  # however few of the processor's seconds this process gets
        monkeypatch.setattr("ddakf_service.workers.compute.lanes._PATIENCE", PATIENCE)
    gate.put(1, "one", content)
    assert gate.aside() == 1


def test_after_a_stop_no_further_answer_begins():
    before = set(threading.enumerate())
    gate = Gate()
    light = next(thread for thread in set(threading.enumerate()) - before if thread.name == "light")
    gate.put(1, "a", b"held")
    gate.put(2, "b", b"held")
    gate.put(3, "c")
    assert [gate.aside(), gate.aside()] == [1, 2]
    gate.lanes.stop()
    gate.released.set()
    assert sorted(gate.answered(2)) == [1, 2]
    light.join(PATIENCE)
    assert not light.is_alive()
    assert gate.told.empty()

"""Watchers, and streams whose program is interrupted."""

import subprocess
import sys
import threading

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import connect
from ddakf_client.watch import watch


class Call:
    """A call that gives results without end and keeps the threads that read it."""

    def __init__(self):
        self.readers, self.cancelled = set(), threading.Event()

    def __iter__(self):
        return self

    def __next__(self):
        self.readers.add(threading.current_thread())
        return pb.TrackResponse(result=pb.Result(sequence_number=1))

    def cancel(self):
        self.cancelled.set()


def test_no_signal_interrupts_the_reading():
    """The exception of its handler, in the main thread, could leave a lock of gRPC taken."""
    call = Call()
    answers = watch(call, print, "somewhere")
    assert [next(answers).sequence for _ in range(5)] == [1] * 5
    with pytest.raises(KeyboardInterrupt):
        answers.throw(KeyboardInterrupt)
    assert call.cancelled.is_set()
    assert len(call.readers) == 1
    assert threading.current_thread() not in call.readers


# A signal comes when the main thread is about to start a thread, such as that of gRPC which completes a new call.
INTERRUPTED = """
import sys, threading
from ddakf_client import connect

start = threading.Thread.start

def interrupted_start(thread):
    if threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt
    start(thread)

with connect(sys.argv[1]) as client:
    session = client.open_session(sys.argv[2])
    threading.Thread.start = interrupted_start
    try:
        {reading}
    except KeyboardInterrupt:
        print("interrupted")
"""


@pytest.mark.parametrize("reading", ["list(session.watch())", "list(session.track([]))"])
def test_a_program_ends_that_is_interrupted_while_it_opens_a_stream(service, mesh, reading):
    with connect(service.target) as client:
        name = client.create_session(*mesh).name
        command = [sys.executable, "-c", INTERRUPTED.format(reading=reading), service.target, name]
        program = subprocess.run(command, capture_output=True, text=True, timeout=30.0)
        assert (program.returncode, program.stdout, program.stderr) == (0, "interrupted\n", "")

"""One worker and the server's end of its connection."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from ddakf_api.errors import WorkerLost
from ddakf_service.workers.fork_server import Connected
from ddakf_service.workers.messages import wire
from ddakf_service.workers.pool import may_be_cause
from ddakf_service.workers.worker import Worker


class Process:
    """A process elsewhere; the calls that it got."""

    pid = 1

    def __init__(self):
        self.calls = []

    def kill(self) -> None:
        self.calls.append("kill")

    def wait(self, timeout: float | None = None) -> int:
        self.calls.append("wait")
        return 0


class Source:
    """Gives one worker over a connection within this process; ``far`` is the other end."""

    def __init__(self, process: Process | subprocess.Popen, here: bool = False):
        self._process, self._here = process, here

    async def worker(self, progress) -> Connected:
        accepted = asyncio.get_running_loop().create_future()
        server = await asyncio.start_server(lambda *ends: accepted.set_result(ends), "127.0.0.1", 0)
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        self.reader, (_, self.far) = reader, await accepted
        server.close()
        return Connected(self._process, reader, writer, self._here)


# A chain of threads, each of which starts the next one; says when it has begun and when it has its last one.
STARTING = """
import threading, time
def link(number):
    if number in (200, 0):
        print(flush=True)
    if number:
        time.sleep(0.0002)
        threading.Thread(target=link, args=(number - 1,), daemon=True).start()
    time.sleep(60)
link(400)
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the system has no /proc")
def test_all_threads_of_a_process_give_way_also_those_that_start_meanwhile():
    with subprocess.Popen([sys.executable, "-c", STARTING], stdout=subprocess.PIPE) as process:
        try:
            process.stdout.readline()
            worker = Worker(process, None, None)
            worker.lower_priority()
            process.stdout.readline()
            threads = [int(name) for name in os.listdir(f"/proc/{process.pid}/task")]
            assert len(threads) > 400
            own = os.getpriority(os.PRIO_PROCESS, 0)
            worker.lower_priority()  # again, for a thread in the middle of its start
            assert {os.getpriority(os.PRIO_PROCESS, thread) for thread in threads} == {min(own + 10, 19)}
        finally:
            process.kill()


@pytest.mark.parametrize("number", [errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ECONNRESET])
async def test_a_vanished_machine_is_a_lost_worker_and_no_invalid_message(number, caplog):
    process = Process()
    source = Source(process)
    worker = await Worker.start(source, 10, lambda *_: None)
    answer = worker.send(wire.Kind.CLOSE, "some")
    source.reader.set_exception(OSError(number, "gone"))
    with caplog.at_level(logging.INFO):
        with pytest.raises(WorkerLost):
            await asyncio.wait_for(answer, 10)
        await asyncio.wait_for(worker.gone.wait(), 10)
    assert caplog.records == []
    source.far.close()


@pytest.mark.parametrize(("program", "status"), [("import os; os.kill(os.getpid(), 9)", -9), ("exit(3)", 3)])
async def test_the_log_has_the_exit_status_of_a_lost_worker(program, status, caplog):
    with subprocess.Popen([sys.executable, "-c", f"input(); {program}"], stdin=subprocess.PIPE) as process:
        source = Source(process, here=True)
        worker = await Worker.start(source, 10, lambda *_: None)
        process.stdin.write(b"\n")
        process.stdin.flush()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # its pipe closes as it ends
        source.far.close()
        await asyncio.wait_for(worker._listener, 10)
    assert [(r.worker, r.status) for r in caplog.records if "has ended" in r.message] == [(process.pid, status)]


async def test_what_is_no_message_costs_the_worker_and_is_logged(caplog):
    source = Source(Process())
    worker = await Worker.start(source, 10, lambda *_: None)
    source.far.write(wire.head(99, 1, "", 0))
    await asyncio.wait_for(worker.gone.wait(), 10)
    assert "invalid message" in caplog.text
    source.far.close()


async def test_a_worker_that_ends_leaves_no_call_without_an_answer():
    source = Source(Process())
    worker = await Worker.start(source, 10, lambda *_: None)
    answer = worker.send(wire.Kind.SNAPSHOT, "some")
    await worker.end()
    for lost in (answer, asyncio.ensure_future(_sent_to(worker))):
        with pytest.raises(WorkerLost) as caught:
            await asyncio.wait_for(lost, 10)
        assert not may_be_cause(caught.value)
    source.far.close()


async def _sent_to(worker: Worker) -> bytes:
    return await worker.send(wire.Kind.SNAPSHOT, "some")


@pytest.mark.parametrize(
    ("kind", "owner", "suspected"),
    [
        (None, "", True),
        (wire.Kind.FRAME, "other", True),
        (wire.Kind.RESTORE, "other", True),
        (wire.Kind.CONFIGURE, "other", False),
        (wire.Kind.OPEN, "other", False),
        (wire.Kind.IMPORT, "other", False),
        (wire.Kind.RESET, "some", True),
    ],
    ids=str,
)
async def test_a_frame_is_no_suspect_where_the_worker_had_a_rarer_request_of_another_session(kind, owner, suspected):
    source = Source(Process())
    worker = await Worker.start(source, 1.0, lambda *_: None)
    answers = [worker.send(wire.Kind.FRAME, "some")]
    if kind:
        answers.append(worker.send(kind, owner))
    source.far.close()
    errors = await asyncio.gather(*answers, return_exceptions=True)
    assert may_be_cause(errors[0]) is suspected
    with pytest.raises(WorkerLost) as later:
        await worker.send(wire.Kind.FRAME, "some")
    assert not may_be_cause(later.value)

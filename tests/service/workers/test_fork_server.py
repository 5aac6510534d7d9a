"""Fork server: the process from which workers are forked, with real processes."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import pytest_asyncio
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.workers.fork_server import ForkedWorkers, WorkerStartFailed
from ddakf_service.workers.messages import wire
from ddakf_service.workers.worker import Worker

from ..conftest import children, frame_of, is_running, name_of
from .test_pool import LIMITS, creation, until

pytestmark = pytest.mark.asyncio(loop_scope="module")

ONLY_ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")


def steps(*_) -> None:
    """Ignores the progress."""


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def source():
    source = ForkedWorkers(LIMITS)
    yield source
    await source.end(patience=5)


async def tracked(worker: Worker, sheet, *, codec_name: str = "raw") -> pb.Result:
    """Result of a first frame in a worker."""
    await worker.send(wire.Kind.OPEN, "one", creation(sheet))
    head = wire.frame_request_head(b"", LIMITS.max_points)
    frame = frame_of(sheet, 1, codec_name=codec_name).SerializeToString()
    return pb.Result.FromString(b"".join(wire.unpack_result(await worker.send(wire.Kind.FRAME, "one", head, frame))))


def threads(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


@pytest.mark.slow
@ONLY_ON_LINUX
async def test_a_fork_of_one_thread_is_a_child_of_this_process_and_outlives_its_fork_server(source, sheet):
    worker = await Worker.start(source, 300, steps)
    fork_server = source._fork_server.process
    assert threads(fork_server.pid) == 1
    assert worker.process.pid in children(os.getpid())
    fork_server.kill()
    await asyncio.to_thread(fork_server.wait)
    assert (await tracked(worker, sheet)).sequence_number == 1
    with pytest.raises((WorkerStartFailed, OSError)):
        await Worker.start(source, 300, steps)
    successor = await Worker.start(source, 300, steps)
    assert (await tracked(successor, sheet)).sequence_number == 1
    for each in (worker, successor):
        await each.end()
        assert each.process.wait() == 0


@ONLY_ON_LINUX
async def test_a_killed_worker_leaves_neither_its_decoder_nor_a_zombie(source, sheet):
    worker = await Worker.start(source, 300, steps)
    assert (await tracked(worker, sheet, codec_name="draco")).sequence_number == 1
    (decoder,) = children(worker.process.pid)
    os.kill(worker.process.pid, signal.SIGKILL)
    await worker.gone.wait()
    await until(lambda: not {decoder, worker.process.pid} & set(children(os.getpid())))
    assert not is_running(decoder)
    assert worker.process.wait() == -signal.SIGKILL


@ONLY_ON_LINUX
async def test_a_fork_server_that_hangs_is_replaced(source, sheet):
    await (await Worker.start(source, 300, steps)).end()
    hanging = source._fork_server.process
    os.kill(hanging.pid, signal.SIGSTOP)
    with pytest.raises(WorkerStartFailed, match="not ready after 1 s"):
        await Worker.start(source, 1, steps)
    assert hanging.poll() == -signal.SIGKILL
    worker = await Worker.start(source, 300, steps)
    assert name_of(worker.process.pid) == "ddakf-worker"
    await worker.end()


@pytest.mark.slow
async def test_where_nothing_may_be_forked_each_worker_has_a_fork_server_of_its_own(sheet):
    source, said = ForkedWorkers(LIMITS, forks=False), []
    workers = [await Worker.start(source, 300, lambda *step: said.append(step)) for _ in range(2)]
    assert [step[1] for step in said if step[0] == "loading"] == [*range(said[-1][2] + 1)] * 2
    for worker in workers:
        assert isinstance(worker.process, subprocess.Popen)
        assert (await tracked(worker, sheet)).sequence_number == 1
        await worker.end()
        assert worker.process.wait() == 0
    await source.end()

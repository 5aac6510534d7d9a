"""Actors whose caller has left, or whose cluster has ended: nothing stays behind, and errors are those of a worker's start."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator

import pytest
from ddakf_service.workers.fork_server import WorkerStartFailed

from .test_pool import LIMITS

ray = pytest.importorskip("ray", reason="ray is not installed: pip install 'ddakf[ray]'")
from ddakf_service.workers import ray_actors  # noqa: E402
from ddakf_service.workers.ray_actors import ActorProcess, RayActors  # noqa: E402

pytestmark = pytest.mark.slow

PROCESSORS = 4
PATIENCE = 120.0  # seconds


@pytest.fixture
def connected(cluster) -> Iterator[str]:
    """The address of a cluster that this process belongs to."""
    ray.init(cluster.address, log_to_driver=False, configure_logging=False)
    yield cluster.address
    ray.shutdown()


def nothing(*_) -> None:
    """Progress that nobody follows."""


async def all_free() -> None:
    """Returns when no actor has a processor."""
    deadline = time.monotonic() + PATIENCE
    while ray.available_resources().get("CPU") != PROCESSORS:
        assert time.monotonic() < deadline
        await asyncio.sleep(0.1)


@pytest.mark.parametrize("seconds", [0.0, 0.001, 0.3, 2.0])
async def test_a_caller_who_leaves_leaves_no_actor(connected, seconds):
    """Whether it is being created, starts, or has just connected."""
    source = RayActors(LIMITS, connected)
    starting = asyncio.create_task(source.worker(nothing))
    await asyncio.sleep(seconds)
    starting.cancel()
    try:
        connected = await starting
    except asyncio.CancelledError:
        pass
    else:  # it was ready already, and the caller ends it
        connected.writer.close()
        await asyncio.to_thread(connected.process.wait, PATIENCE)
    assert source._expected == {}
    await all_free()
    await source.end()


async def test_a_killed_actor_is_not_waited_for(connected):
    server = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0)
    host, port = server.sockets[0].getsockname()
    process = await asyncio.to_thread(ActorProcess, host, port, bytes(32), LIMITS.to_json())
    assert process.failure() == ""
    process.kill()
    assert process.wait() == 1
    await all_free()
    server.close()


async def test_a_node_has_no_more_actors_than_processors(connected):
    """One more waits until another has ended."""
    connections: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = asyncio.Queue()
    server = await asyncio.start_server(lambda *ends: connections.put_nowait(ends), "127.0.0.1", 0)
    host, port = server.sockets[0].getsockname()
    tokens = [bytes([number]) * 32 for number in range(PROCESSORS + 1)]
    actors = {token: await asyncio.to_thread(ActorProcess, host, port, token, LIMITS.to_json()) for token in tokens}
    try:
        async with asyncio.timeout(PATIENCE):
            arrived = [await connections.get() for _ in range(PROCESSORS)]
            assert ray.available_resources().get("CPU", 0) == 0
            assert connections.empty()
            actors[await arrived[0][0].readexactly(32)].kill()
            arrived.append(await connections.get())
    finally:
        for actor in actors.values():
            actor.kill()
    for _, writer in arrived:
        writer.close()
    server.close()
    await all_free()


async def test_an_actor_whose_work_failed_is_gone(connected):
    """Its server has closed the connection before the answers were read."""
    server = await asyncio.start_server(lambda _, writer: writer.transport.abort(), "127.0.0.1", 0)
    host, port = server.sockets[0].getsockname()
    process = await asyncio.to_thread(ActorProcess, host, port, bytes(32), LIMITS.to_json())
    assert await asyncio.to_thread(process.wait, PATIENCE) == 1
    await all_free()
    server.close()


async def test_without_its_cluster_no_worker_starts_and_the_pool_may_try_again(connected):
    source = RayActors(LIMITS, connected)
    async with source._lock:
        await source._connect()
    ray.shutdown()
    with pytest.raises(WorkerStartFailed, match="no actor can be created: the connection to the cluster has ended"):
        await source.worker(nothing)
    assert not ray.is_initialized(), "no call has started another cluster"
    assert source._expected == {}
    await source.end()


async def test_the_end_of_the_servers_own_node_is_noticed_and_the_next_worker_connects_again(cluster, monkeypatch):
    """Actors cannot be created from a node that has ended, though its cluster goes on."""
    monkeypatch.setattr(ray_actors, "_NODES_INTERVAL", 0.2)
    source, ended = RayActors(LIMITS, cluster.address), []
    monkeypatch.setattr(ray_actors, "_has_ended", lambda node: bool(ended))
    first = await source.worker(nothing)
    waiting = asyncio.create_task(source.worker(nothing))
    while not source._expected:
        await asyncio.sleep(0)
    ended.append(source._node)
    with pytest.raises(WorkerStartFailed):
        await waiting
    await source._following
    ended.clear()
    assert not ray.is_initialized()
    assert await asyncio.to_thread(first.process.wait, PATIENCE) == 1
    first.writer.close()
    again = await source.worker(nothing)
    assert again.process.pid > 0
    again.writer.close()
    await asyncio.to_thread(again.process.wait, PATIENCE)
    await source.end()


def test_the_state_of_a_node_is_that_of_the_cluster(connected):
    node = ray.get_runtime_context().get_node_id()
    assert not ray_actors._has_ended(node)
    assert not ray_actors._has_ended("of another cluster")
    ray.shutdown()
    assert not ray_actors._has_ended(node), "nobody knows"
    assert not ray.is_initialized()

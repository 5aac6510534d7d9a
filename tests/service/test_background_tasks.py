"""Tasks that go on when their caller leaves."""

from __future__ import annotations

import asyncio

import pytest
from ddakf_service.background_tasks import BackgroundTasks


async def test_a_cancelled_caller_returns_when_the_work_is_complete():
    tasks, steps, may_end = BackgroundTasks(), [], asyncio.Event()

    async def work() -> None:
        steps.append("begun")
        await may_end.wait()
        steps.append("ended")

    caller = asyncio.create_task(tasks.complete(work()))
    await asyncio.sleep(0)
    caller.cancel()
    await asyncio.sleep(0.01)
    assert (steps, caller.done()) == (["begun"], False)
    may_end.set()
    with pytest.raises(asyncio.CancelledError):
        await caller
    assert (steps, len(tasks)) == (["begun", "ended"], 0)


async def test_it_waits_for_tasks_that_others_start_and_not_for_ever():
    tasks = BackgroundTasks()

    async def chain(length: int) -> None:
        if length:
            tasks.start(chain(length - 1))

    tasks.start(chain(5))
    await tasks.settle(10.0)
    assert len(tasks) == 0
    tasks.start(asyncio.sleep(100.0))
    await tasks.settle(0.01)
    assert len(tasks) == 1
    await tasks.cancel()
    assert len(tasks) == 0

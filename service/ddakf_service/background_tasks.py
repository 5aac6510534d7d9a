"""Background tasks: work of the event loop that goes on when its caller leaves."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from time import monotonic
from typing import Any


class BackgroundTasks:
    """Holds tasks until they end: the event loop itself has only weak references to them."""

    def __init__(self):
        self._tasks: set[asyncio.Task] = set()

    def __len__(self) -> int:
        return len(self._tasks)

    def start(self, work: Coroutine) -> asyncio.Task[Any]:
        """Runs a task in the background."""
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def complete(self, work: Coroutine[None, None, None]) -> None:
        """Runs work to its end, also when the caller is cancelled, who returns only then: a lock that he holds stays held."""
        task = self.start(work)
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError:
            await asyncio.wait({task})
            if not task.cancelled():
                task.exception()  # marks it as retrieved: asyncio would log it otherwise
            raise
        finally:
            del task  # the traceback of its error refers to this Python frame: a reference cycle

    async def settle(self, timeout: float) -> None:
        """Returns when no task is left, or after ``timeout`` seconds."""
        end = monotonic() + timeout
        while self._tasks and (remaining := end - monotonic()) > 0:  # a task may start another
            await asyncio.wait(set(self._tasks), timeout=remaining)

    async def cancel(self) -> None:
        """Cancels all tasks and returns when they have ended."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

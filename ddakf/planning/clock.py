"""Clock of a frame: seconds of its stages, the budget that it plans with, and the limit beyond which it is given up."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from ddakf.errors import FrameTooCostly, InvalidArgument, is_number, shown
from ddakf.results import FrameResult

LONGEST = 1e12  # s, of a budget


class Clock:
    """Adds up the seconds of each stage: ``with clock("fuse"): ...``.

    Args:
        budget: processor seconds of this thread that the frame may use, for :mod:`ddakf.planning.plan`; None: all that it wants.
        limit: processor seconds of this thread. The stage that exceeds it raises ``FrameTooCostly`` at its end.

    Raises:
        InvalidArgument: a budget that is no positive number, or beyond LONGEST, a limit that is none.
    """

    def __init__(self, budget: float | None = None, limit: float = math.inf) -> None:
        if budget is not None and not (is_number(budget) and budget > 0 and abs(budget) < LONGEST):
            raise InvalidArgument("budget", f"processor seconds above 0 and below {LONGEST:g}, or None", shown(budget))
        if not is_number(limit) or math.isnan(limit):
            raise InvalidArgument("limit", "processor seconds", shown(limit))
        self.budget, self._limit = budget, limit
        self._start, self._thread_start = time.perf_counter(), time.thread_time()
        self._seconds: dict[str, float] = {}
        self._processor: dict[str, list[float]] = {}
        self._stage_begun = self._thread_start

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begun, self._stage_begun = time.perf_counter(), time.thread_time()
        yield
        self._seconds[stage] = self._seconds.get(stage, 0.0) + time.perf_counter() - begun
        now = time.thread_time()
        self._processor.setdefault(stage, []).append(now - self._stage_begun)
        if now - self._thread_start > self._limit:
            used = now - self._thread_start
            raise FrameTooCostly(f"the frame used {used:.3g} s of processor time up to {stage}, {self._limit:.3g} s are allowed")

    def left(self) -> float:
        """Processor seconds of the budget that are left. What the stage did before is none of its own costs."""
        self._stage_begun = time.thread_time()
        return self.budget - (self._stage_begun - self._thread_start)

    def spent(self, *stages: str) -> list[float]:
        """Processor seconds of the first, second ... run of these stages together."""
        runs = [self._processor[stage] for stage in stages if stage in self._processor]
        return [sum(seconds) for seconds in zip(*runs, strict=True)]

    def timed(self, result: FrameResult) -> FrameResult:
        """The result with the seconds of its stages, of the whole, and its usage of processor time."""
        result.timings.update(self._seconds, total=time.perf_counter() - self._start)
        seconds, prediction = time.thread_time() - self._thread_start, self.spent("predict")[0]
        return replace(result, usage=result.usage._replace(seconds=seconds, prediction=prediction, budget=self.budget))

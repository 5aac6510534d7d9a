"""Worker processes for trials. A process that dies loses only its own trial, and none outlives its parent."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import cache
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait

from threadpoolctl import threadpool_limits

from ddakf.commands import warmup
from ddakf.evaluation.trials.runs import run_trial
from ddakf.evaluation.trials.trial import Trial

SPAWN = get_context("spawn")


def rows(wanted: list[Trial], procs: int) -> Iterator[dict]:
    """The rows of :func:`ddakf.evaluation.trials.runs.run_trial`, in the order in which they finish.

    Args:
        wanted: trials, begun in this order.
        procs: processes, of one thread each; 1: this one.
    """
    if procs == 1:
        prepare()
        yield from map(run_trial, wanted)
        return
    left = deque(wanted)
    busy: dict[Connection, _Worker] = {}
    try:
        for _ in range(min(procs, len(left))):
            worker = _Worker()
            busy[worker.begin(left.popleft())] = worker
        while busy:
            for connection in wait(busy):
                worker = busy.pop(connection)
                row = worker.row()
                if left:
                    worker = _Worker() if worker.dead else worker
                    busy[worker.begin(left.popleft())] = worker
                yield row
    finally:
        for worker in busy.values():
            worker.process.terminate()
            worker.process.join()


@cache
def prepare() -> None:
    """Sets one thread and compiles the kernels, so that times contain neither."""
    threadpool_limits(1)
    warmup.warm()


class _Worker:
    """A process that runs trials one after another."""

    def __init__(self) -> None:
        self.connection, far = SPAWN.Pipe()
        self.process = SPAWN.Process(target=_work, args=(far,), daemon=True)
        self.dead = False
        with _ignoring_interrupts():
            self.process.start()
        far.close()

    def begin(self, trial: Trial) -> Connection:
        """Sends a trial, and returns the connection on which its row arrives."""
        self.trial = trial
        with suppress(ConnectionError):  # the process has died: row() reports it
            self.connection.send(trial)
        return self.connection

    def row(self) -> dict:
        """The finished row; if the process has died, a row that says so."""
        try:
            return self.connection.recv()
        except (EOFError, ConnectionError):
            self.process.join()
            self.dead = True
            return asdict(self.trial) | {"failed": f"its process ended with status {self.process.exitcode} (out of memory?)"}


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Processes that start meanwhile ignore Ctrl-C, which a terminal sends to all of them. The parent ends them."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread can set signal handlers
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _work(connection: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    prepare()
    while True:
        try:
            trial = connection.recv()
        except EOFError:
            return
        connection.send(run_trial(trial))


def _end_with_parent() -> None:
    parent_process().join()
    os._exit(1)

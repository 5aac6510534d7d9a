"""Busy time counts a moment once, however many frames are tracked in it."""

import threading
from time import perf_counter, sleep

from ddakf_service.workers.compute.busy_time import BusyTime


def test_frames_at_once_count_once():
    busy, inside, leave = BusyTime(), threading.Barrier(4), threading.Event()

    def frame():
        with busy:
            inside.wait(30)
            leave.wait(30)

    began = perf_counter()
    threads = [threading.Thread(target=frame) for _ in range(3)]
    for thread in threads:
        thread.start()
    inside.wait(30)
    entered = perf_counter()
    sleep(0.05)
    left = perf_counter()
    leave.set()
    for thread in threads:
        thread.join()
    assert left - entered <= busy.taken() <= perf_counter() - began


def test_idle_time_does_not_count():
    busy = BusyTime()
    with busy:
        pass
    sleep(0.05)
    assert busy.taken() < 0.05
    assert busy.taken() == 0.0

"""Reading ahead: a thread reads a server's answers while the caller works on earlier ones.

It also keeps the main thread out of gRPC, where KeyboardInterrupt, or the exception of another signal's handler, can leave a lock
taken, for which gRPC's own threads then wait.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from typing import NamedTuple, TypeVar

Item = TypeVar("Item")

_LOOK_INTERVAL = 0.1  # seconds between looks whether the reader has left


class _End(NamedTuple):
    error: BaseException | None


def read_ahead(source: Iterable[Item], capacity: int) -> Iterator[tuple[Item, int]]:
    """Yields the items of a source, which a thread reads, each with the number of those that wait behind it.

    Args:
        capacity: items that may wait; then the source waits.

    Raises:
        Whatever the source raises, after the items before it.
    """
    waiting: queue.Queue[Item | _End] = queue.Queue(capacity)
    left = threading.Event()

    def put(item: Item | _End) -> None:
        while not left.is_set():
            try:
                return waiting.put(item, timeout=_LOOK_INTERVAL)
            except queue.Full:
                continue

    def read() -> None:
        error = None
        try:
            for item in source:
                put(item)
                if left.is_set():
                    return
        except BaseException as raised:  # it is raised where the items are read
            error = raised
        put(_End(error))

    threading.Thread(target=read, name="ddakf-reader", daemon=True).start()
    try:
        while not isinstance(item := waiting.get(), _End):
            yield item, waiting.qsize()
        if item.error is not None:
            raise item.error
    finally:
        left.set()

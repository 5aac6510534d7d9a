"""A client that streams in a thread while a test kills, drains or moves what it streams to."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

from ddakf_client import Frame, connect

from .conftest import TIMEOUT, make_sheet

RATE = 20  # frames per second


class LosslessStream(threading.Thread):
    """A lossless stream of a client that knows one or several addresses, until it is told to end.

    Args:
        patience: seconds for the next answer, and for a new connection.

    Attributes:
        sent: number of frames. answered: numbers of those with an answer. notices: their kinds.
        longest: seconds between two answers. forgotten: answered frames that the server lost.
    """

    def __init__(self, *addresses: str, patience: float = TIMEOUT):
        super().__init__()
        self._addresses, self._patience, self._wanted = addresses, patience, threading.Event()
        self._wanted.set()
        self.sent, self.answered, self.notices, self.longest, self.forgotten = 0, [], [], 0.0, 0.0

    def run(self) -> None:
        sheet = make_sheet()
        with (
            connect(self._addresses, timeout=self._patience) as client,
            client.create_session(*sheet, flow="lossless") as session,
        ):
            last = time.monotonic()
            for result in session.track(self._frames(sheet), on_notice=self._note, resume=self._patience):
                self.longest, last = max(self.longest, time.monotonic() - last), time.monotonic()
                self.answered.append(result.sequence)

    def _note(self, notice) -> None:
        self.notices.append(notice.kind)
        self.forgotten += notice.value if notice.kind == "resumed" else 0

    def _frames(self, sheet) -> Iterator[Frame]:
        while self._wanted.is_set():
            self.sent += 1
            yield Frame(sheet.vertices + [0.001 * self.sent, 0, 0], self.sent / RATE)
            time.sleep(1 / RATE)

    def end(self) -> None:
        self._wanted.clear()
        self.join(self._patience)
        assert not self.is_alive()

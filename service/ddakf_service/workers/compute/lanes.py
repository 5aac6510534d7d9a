"""Lanes of a worker: light requests take turns, heavy ones and those that build a model take theirs beside them.

A request on the light lane has the turn until it is answered or has used its slice. After the slice it goes on aside, and the
next request has the turn. A frame of one session therefore holds up those of the others for a slice at most. The requests of
one session are answered in their order.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue

from ..messages.wire import Kind, Message

log = logging.getLogger(__name__)

SLICE = 0.05  # processor seconds of a turn: as many as a frame of 10,000 vertices takes
_PATIENCE = 0.2  # seconds of a turn, also where the request waits: for the process of a decoder, or for a core
_ASIDE = 1  # requests that may go on aside at a time
FRAMES = 2 + _ASIDE  # requests that a worker answers at a time beside the building of a model; each takes the memory of a frame

_BUILDING = {Kind.OPEN, Kind.IMPORT, Kind.RESTORE, Kind.CONFIGURE}


class Lanes:
    """Answers requests on threads.

    Args:
        answer: the answer to a request; called by several threads, for one request of a session at a time.
        send: sends a message to the server; called by one thread at a time. It receives the answers, and ASIDE for each
            request whose turn is over without an answer.
    """

    def __init__(self, answer: Callable[[Message], Message], send: Callable[[Message], None]):
        self._answer, self._send = answer, send
        self._light, self._heavy, self._building = SimpleQueue(), SimpleQueue(), SimpleQueue()
        self._unanswered: dict[str, deque[Message]] = {}  # by session, the one on a lane first
        self._n_aside, self._stopped = 0, False
        self._changed, self._sending = threading.Condition(), threading.Lock()
        self._threads = ThreadPoolExecutor(FRAMES + 1, "lane")
        for name, requests, makes_room in (
            ("light", self._light, self._go_aside),
            ("heavy", self._heavy, self._wait_for_end),
            ("building", self._building, self._wait_for_end),
        ):
            threading.Thread(target=self._serve, args=(requests, makes_room), name=name, daemon=True).start()

    def put(self, request: Message) -> None:
        """Queues a request behind the earlier ones of its session."""
        with self._changed:
            unanswered = self._unanswered.setdefault(request.session_id, deque())
            unanswered.append(request)
            if len(unanswered) == 1:
                self._enqueue(request)

    def stop(self) -> None:
        """Begins no further answer. Those that have begun are finished."""
        with self._changed:
            self._stopped = True

    def _enqueue(self, request: Message) -> None:
        if request.kind in _BUILDING:
            self._building.put(request)
        else:
            (self._heavy if request.kind is Kind.HEAVY_FRAME else self._light).put(request)

    def _serve(self, requests: SimpleQueue[Message], makes_room: Callable[[_Turn], None]) -> None:
        """Gives each request of a lane its turn."""
        while True:
            turn = _Turn(requests.get())
            with self._changed:
                if self._stopped:
                    return
                self._threads.submit(self._answer_on_thread, turn)
            if not self._ends_in_time(turn):
                self._tell(Message(Kind.ASIDE, turn.request.number))
                makes_room(turn)

    def _ends_in_time(self, turn: _Turn) -> bool:
        end = time.monotonic() + _PATIENCE
        with self._changed:
            while (rest := min(SLICE - turn.processor_seconds(), end - time.monotonic())) > 0:
                if self._changed.wait_for(lambda: turn.ended, rest):
                    return True
        return False

    def _go_aside(self, turn: _Turn) -> None:
        """Waits for the end or for a place aside."""
        with self._changed:
            self._changed.wait_for(lambda: turn.ended or self._n_aside < _ASIDE)
            if not turn.ended:
                turn.aside = True
                self._n_aside += 1

    def _wait_for_end(self, turn: _Turn) -> None:
        with self._changed:
            self._changed.wait_for(lambda: turn.ended)

    def _answer_on_thread(self, turn: _Turn) -> None:
        turn.begin()
        try:
            self._tell(self._answer(turn.request))
        except BaseException:  # an answer cannot be made or sent: the server replaces this process
            log.exception("a worker failed")
            os._exit(1)
        self._end(turn)

    def _end(self, turn: _Turn) -> None:
        with self._changed:
            turn.ended = True
            self._n_aside -= turn.aside
            self._changed.notify_all()
            unanswered = self._unanswered[turn.request.session_id]
            unanswered.popleft()
            if unanswered:
                self._enqueue(unanswered[0])
            else:
                del self._unanswered[turn.request.session_id]

    def _tell(self, message: Message) -> None:
        # Without a server this process ends through its reading side.
        with self._sending, contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self._send(message)


class _Turn:
    """A request that is being answered.

    Attributes:
        ended: it has been answered.
        aside: it has a place aside.
    """

    def __init__(self, request: Message):
        self.request = request
        self.ended = self.aside = False
        self._clock: tuple[int, float] | None = None

    def begin(self) -> None:
        """To be called by the thread that answers."""
        if hasattr(time, "pthread_getcpuclockid"):  # not on macOS
            clock = time.pthread_getcpuclockid(threading.get_ident())
            self._clock = clock, time.clock_gettime(clock)

    def processor_seconds(self) -> float:
        """Those of the thread that answers; 0 before it begins."""
        if self._clock is None:
            return 0.0
        clock, begun = self._clock
        return time.clock_gettime(clock) - begun

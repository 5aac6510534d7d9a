"""Placement: the worker of a session, and the turns of its frames there."""

from __future__ import annotations

import asyncio

from .compute.lanes import SLICE
from .messages import wire
from .worker import Worker

_HEAVY_FRAMES = 30  # frames that a session stays on the heavy lane after one that exceeded its slice


class Placement:
    """The worker of a session.

    Attributes:
        lock: held during a call of the session in the worker, and during a move.
        heavy_frames: number of coming frames on the heavy lane.
    """

    def __init__(self, worker: Worker):
        self.worker = worker
        self.lock = asyncio.Lock()
        self.heavy_frames = 0


class Turn:
    """Context in which a frame has a slot on a lane of its worker: until its answer, or until its turn is over.

    Attributes:
        kind: of the request.
    """

    def __init__(self, placement: Placement):
        self._placement = placement
        heavy, worker = placement.heavy_frames > 0, placement.worker
        self.kind = wire.Kind.HEAVY_FRAME if heavy else wire.Kind.FRAME
        self._slots = worker.heavy_slots if heavy else worker.frame_slots
        self._has_slot = self._exceeded = False

    async def __aenter__(self) -> Turn:
        await self._slots.acquire()
        self._has_slot = True
        return self

    async def __aexit__(self, *_) -> None:
        self._release()
        if not self._exceeded:
            self._placement.heavy_frames = max(self._placement.heavy_frames - 1, 0)

    def took(self, processor_seconds: float) -> None:
        """The frame has been answered; if it has used more than a slice, the next frames of its session go to the heavy lane."""
        if processor_seconds > SLICE:
            self._exceeded, self._placement.heavy_frames = True, _HEAVY_FRAMES

    def over(self) -> None:
        """The frame continues aside."""
        if self.kind is wire.Kind.FRAME:
            self._release()

    def _release(self) -> None:
        if self._has_slot:
            self._has_slot = False
            self._slots.release()

"""The interface of a worker pool. Payloads are serialised messages, so that a pool may live on other machines."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple, Protocol

from ddakf_api.errors import WorkerLost

RETRY_AFTER = 1.0  # seconds, told to clients: about what a replacement takes with a warm kernel cache

# Called with (kernels compiled, kernels in all, name of the next one) while the first worker warms up.
Progress = Callable[[int, int, str], None]

# Called with the ids of the sessions whose state went with their worker.
OnLost = Callable[[Sequence[str]], None]


@dataclass(frozen=True)
class Limits:
    """What one request may contain; checked before memory is taken for it."""

    max_points: int
    max_vertices: int
    max_faces: int
    max_body_vertices: int

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Limits:
        return cls(**json.loads(text))


class Health(NamedTuple):
    """State of a pool: workers that take frames, workers that there should be, and how often one was replaced."""

    ready: int
    wanted: int
    restarts: int


def worker_lost(session_id: str) -> WorkerLost:
    """What everyone is told who asks for a session that went with its worker."""
    message = f"the worker of sessions/{session_id} was lost; create the session anew"
    return WorkerLost(message, retry_after=RETRY_AFTER)


class WorkerPool(Protocol):
    """Sessions pinned to workers.

    Every call raises ``WorkerLost`` when the session's worker is gone (the session must be created anew), and the
    error that the worker raised, with its field, when the payload cannot be used (the session is as it was).
    One call per session at a time; calls of different sessions overlap.
    """

    async def start(self, progress: Progress) -> None:
        """Returns when every worker has compiled its kernels and tracked a frame."""

    async def open(self, session_id: str, request: bytes) -> bytes:
        """Creates a session on the least loaded worker: CreateSessionRequest in, Session with its meshes out."""

    async def restore(self, session_id: str, request: bytes) -> bytes:
        """Creates a session from a snapshot: RestoreSessionRequest in, Session with its meshes out."""

    async def submit(self, session_id: str, frame: bytes, options: bytes) -> bytes:
        """Tracks one frame: Frame and ResultOptions in, Result out."""

    async def reset(self, session_id: str, request: bytes) -> None:
        """Starts the session's tracker again: ResetSessionRequest in."""

    async def snapshot(self, session_id: str) -> bytes:
        """The state of the session's tracker."""

    async def close(self, session_id: str) -> None:
        """Forgets the session; unknown sessions are ignored."""

    def health(self) -> Health:
        """As of now, without waiting."""

    async def stop(self) -> None:
        """Ends all workers; returns when no process is left."""

"""The interface of a worker pool. Payloads are serialised messages, so that a pool may live on other machines."""

from __future__ import annotations

import json
import math
from collections.abc import Awaitable, Callable, Sequence
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
    max_image_pixels: int

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Limits:
        return cls(**json.loads(text))


class Memory(NamedTuple):
    """Estimated memory of a session in its worker, bytes.

    Attributes:
        kept: for as long as the session lives.
        frame: on top of that while a frame is tracked. A worker tracks one frame at a time, so that its sessions share this.
    """

    kept: int = 0
    frame: int = 0

    @classmethod
    def of(cls, vertices: int, faces: int, body_vertices: int, body_faces: int, points: int) -> Memory:
        """Of a garment and a body, and frames of ``points``. The factors are rounded up from measured growth of a worker."""
        kept = (1 << 20) + 1500 * vertices + 200 * faces + 900 * body_vertices + 100 * body_faces
        return cls(kept, 1500 * vertices + 300 * points)


UNKNOWN = Memory(0, 0)


class Health(NamedTuple):
    """State of a pool: workers that take frames, workers that there should be, how often one was lost, warm spares that wait,
    and how often one was replaced in order."""

    ready: int
    wanted: int
    restarts: int
    spares: int = 0
    recycled: int = 0


def worker_lost(session_id: str) -> WorkerLost:
    """What everyone is told who asks for a session that went with its worker."""
    return WorkerLost(f"the worker of sessions/{session_id} was lost", retry_after=RETRY_AFTER)


class WorkerPool(Protocol):
    """Sessions pinned to workers.

    Every call raises ``WorkerLost`` when the session's worker is gone (the session must be opened or restored again), and the
    error that the worker raised, with its field, when the payload cannot be used (the session is as it was).
    One call per session at a time, :meth:`snapshot` excepted; calls of different sessions overlap, and their frames are tracked
    in turn. A pool may move sessions between its workers; calls wait meanwhile.
    """

    async def start(self, progress: Progress) -> None:
        """Returns when every worker has compiled its kernels and tracked a frame; spares come later."""

    async def open(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        """Creates a session on the least loaded worker: CreateSessionRequest in, Session with its meshes out.

        Raises:
            ResourceExhausted: no worker has so much memory left.
        """

    async def restore(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        """Creates a session from a snapshot: RestoreSessionRequest in, Session with its meshes out. Raises as :meth:`open`."""

    async def submit(self, session_id: str, frame: bytes, options: bytes, *, max_points: int, turn_by: float = math.inf) -> bytes:
        """Tracks one frame of at most ``max_points``: Frame and ResultOptions in, Result out.

        Raises:
            DeadlineExceeded: its turn did not come before ``turn_by`` (monotonic clock, seconds); it was not tracked.
        """

    async def configure(self, session_id: str, request: bytes) -> bytes:
        """Another configuration from the next frame on: Session with config_json and fabric in, with the whole config out."""

    async def reset(self, session_id: str, request: bytes) -> None:
        """Starts the session's tracker again: ResetSessionRequest in."""

    def snapshot(self, session_id: str, *, compressed: bool = False) -> Awaitable[bytes]:
        """The state of the session's tracker as the calls before this one left it, whatever is called before it is answered."""

    async def close(self, session_id: str) -> None:
        """Forgets the session; unknown sessions are ignored."""

    def health(self) -> Health:
        """As of now, without waiting."""

    def process_ids(self) -> list[int]:
        """Of the workers that take frames."""

    async def stop(self) -> None:
        """Ends all workers; returns when no process is left."""

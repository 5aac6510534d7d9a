"""Interface of a worker pool: requests and answers are serialised messages, so that workers may run on other machines."""

from __future__ import annotations

import json
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple, Protocol

from ddakf_api.errors import WorkerLost

_LIMIT_VERTICES, _LIMIT_POINTS = 20_000, 100_000  # for each of these a frame may use as much again

RETRY_AFTER = 1.0  # seconds; a worker is replaced in less, a lost fork server in two or three times as long

# Called with ("loading" or "compiling", done steps, total, name of the next) while the kernels are loaded.
Progress = Callable[[str, int, int, str], None]

# Called with the ids of the sessions that were lost with their worker.
OnLost = Callable[[Sequence[str]], None]


@dataclass(frozen=True)
class Limits:
    """Upper bounds of one request, checked before memory is allocated."""

    max_points: int
    max_vertices: int
    max_faces: int
    max_body_vertices: int
    max_image_pixels: int
    frame_limit: float = math.inf  # processor seconds, of a frame without vertices and points

    def processor_limit(self, vertices: int, points: int) -> float:
        """Processor seconds that a frame may use."""
        return self.frame_limit * (1 + vertices / _LIMIT_VERTICES + points / _LIMIT_POINTS)

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Limits:
        return cls(**json.loads(text))


class Memory(NamedTuple):
    """Estimated memory of a session in its worker, bytes.

    Attributes:
        session: for the life of the session.
        frame: in addition while a frame is tracked. A worker tracks few frames at a time, so its sessions share this part.
    """

    session: int = 0
    frame: int = 0

    @classmethod
    def of(cls, vertices: int, faces: int, body_vertices: int, body_faces: int, points: int) -> Memory:
        """Estimate for a garment, a body and frames of ``points``. The factors are rounded up from a worker's measured growth."""
        session = (1 << 20) + 1500 * vertices + 200 * faces + 900 * body_vertices + 100 * body_faces
        return cls(session, 1500 * vertices + 300 * points)


UNKNOWN = Memory(0, 0)


class Health(NamedTuple):
    """State of a pool.

    Attributes:
        ready: workers that accept frames.
        wanted: configured number of those.
        restarts: workers lost since the start.
        spares: warm workers in reserve.
        recycled: workers replaced in order since the start.
    """

    ready: int
    wanted: int
    restarts: int
    spares: int = 0
    recycled: int = 0


def worker_lost(session_id: str, *, suspected: bool = False) -> WorkerLost:
    """The error of a call for a session whose worker was lost.

    Args:
        suspected: the call's request may have been the cause, see :func:`may_be_cause`.
    """
    error = WorkerLost(f"the worker of sessions/{session_id} was lost", retry_after=RETRY_AFTER)
    error.suspected = suspected
    return error


def may_be_cause(error: WorkerLost) -> bool:
    """Whether the call that raised this error had its request in the worker, and no other session had one but for frames."""
    return getattr(error, "suspected", False)


class WorkerPool(Protocol):
    """Sessions pinned to workers.

    Every call raises ``WorkerLost`` when the session's worker is lost; the session must then be opened or restored again.
    A call raises the worker's error, with its field, when the request is invalid; the session stays unchanged.
    One call per session at a time, except :meth:`snapshot`. Calls of different sessions overlap; a worker tracks their frames
    in turn, costly ones beside the others. A pool may move sessions between its workers; calls wait meanwhile.
    """

    async def start(self, progress: Progress) -> None:
        """Returns when every worker has compiled its kernels and tracked a frame; spares start later."""

    async def open(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        """Creates a session on the least loaded worker: CreateSessionRequest in, Session with its meshes out.

        Raises:
            ResourceExhausted: no worker has enough memory.
        """

    async def import_snapshot(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        """Creates a session from a client's snapshot: RestoreSessionRequest in, Session with its meshes out.

        A worker lost meanwhile is blamed on this request, not on the frames of other sessions. Raises as :meth:`open`.
        """

    async def restore(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        """As :meth:`import_snapshot`, of a checkpoint of the service, which is not blamed."""

    async def submit(
        self,
        session_id: str,
        frame: bytes | memoryview,
        options: bytes,
        *,
        max_points: int,
        start_by: float = math.inf,
        rate: float = 0.0,
    ) -> tuple[bytes, bytes | memoryview]:
        """Tracks one frame of at most ``max_points``: Frame and ResultOptions in, Result out.

        Args:
            rate: frames per second of the session; they share the worker's time, and get budgets. 0: no budget.

        Returns:
            The serialised Result without its arrays, and with its arrays alone; their concatenation is the serialised Result.

        Raises:
            DeadlineExceeded: the worker was not free before ``start_by`` (monotonic clock, seconds); the frame was not tracked.
            FrameTooCostly: the frame exceeded its limit of processor time; the session is as it was.
        """

    def affordable_rate(self, session_id: str) -> float:
        """Frames per second that the session's share of its worker allows, however much a budget leaves out; 0: not limited."""

    async def configure(self, session_id: str, request: bytes) -> bytes:
        """Changes the configuration from the next frame on: UpdateSessionRequest with config_json, fabric or both in, Session
        with the full configuration and its fabric out."""

    async def reset(self, session_id: str, request: bytes) -> None:
        """Resets the session's tracker: ResetSessionRequest in."""

    def snapshot(self, session_id: str, *, compressed: bool = False) -> Awaitable[bytes]:
        """The tracker's state after all earlier calls; later calls do not change the answer."""

    def count_memory(self, session_id: str, memory: Memory) -> None:
        """Counts this much for a session from now on.

        Raises:
            ResourceExhausted: its worker has not so much; the session counts as before.
        """

    async def isolate(self, session_id: str) -> None:
        """Moves a session to a worker of low priority that serves isolated sessions only.

        Raises:
            ResourceExhausted, Unavailable: that worker has too little memory, or cannot be started; the session stays.
        """

    async def close(self, session_id: str) -> None:
        """Removes the session; an unknown session is ignored."""

    def health(self) -> Health:
        """Current state, without waiting."""

    def process_ids(self) -> list[int]:
        """Process ids of the workers that accept frames."""

    async def stop(self) -> None:
        """Ends all workers; returns when no process is left."""

"""Admission: checks of a new session's id, labels and limits, and quotas of sessions and streams."""

from __future__ import annotations

import math
import secrets
from collections.abc import Sequence

from ddakf_api.errors import Draining, InvalidArgument, ResourceExhausted
from ddakf_api.v1 import tracking_pb2 as pb

from ...auth.principal import Principal
from ...settings import Settings
from ...workers.pool import Memory
from ..session import is_session_id

_MAX_TEXT = 256  # characters of a label, its value or a request id
_MAX_LABELS = 64  # of a session
_RETRY_WHEN_FULL = 5.0  # seconds
_RESTORED_BYTES_PER_SNAPSHOT_BYTE = 8  # upper bound of a restored tracker's memory
_REAL_LIMITS = {
    "max_frame_rate": "frames per second",
    "idle_timeout": "seconds",
    "max_lifetime": "seconds",
    "departure_timeout": "seconds",
}


class Admission:
    """The server's bounds on requested sessions and streams. An invalid value raises ``InvalidArgument`` with its field.

    Attributes:
        draining: the server is about to stop and accepts no sessions or streams.
    """

    def __init__(self, settings: Settings):
        self._settings = settings
        self.draining = False

    def require_running(self, work: str) -> None:
        """Rejects new work while the server drains, because the last checkpoints would miss it.

        Args:
            work: plural noun for the message, such as "streams".

        Raises:
            Draining
        """
        if self.draining:
            raise Draining(f"the server is about to stop and accepts no new {work}")

    def require_room(self, principal: Principal, owners: Sequence[str | None]) -> None:
        """Rejects a session beyond the quota of the server or of its key.

        Args:
            owners: the key of each live session.

        Raises:
            ResourceExhausted: the message names the server or the key.
        """
        self.require_server_room(len(owners))
        self.require_key_room(principal, owners.count(principal.id))

    def require_server_room(self, count: int) -> None:
        """Rejects a session beyond the quota of the server, which has ``count``; raises as :meth:`require_room`."""
        _require_below(self._settings.max_sessions, count, "the server")

    def require_key_room(self, principal: Principal, count: int) -> None:
        """Rejects a session beyond the quota of a key, which has ``count``; raises as :meth:`require_room`."""
        _require_below(principal.max_sessions or self._settings.max_sessions_per_key, count, "the key")

    def require_stream_room(self, principal: Principal, key_ids: Sequence[str]) -> None:
        """Rejects a stream or a watcher beyond the quota of its key. Callers without a key are bounded per session only.

        Args:
            key_ids: the key of each stream and watcher.

        Raises:
            ResourceExhausted
        """
        maximum = self._settings.max_streams_per_key
        if principal.id and key_ids.count(principal.id) >= maximum:
            raise ResourceExhausted(
                f"streams: the key has its {maximum} streams and watchers already; try again later or end one",
                retry_after=_RETRY_WHEN_FULL,
            )

    def limits(self, requested: pb.SessionLimits) -> pb.SessionLimits:
        """The requested limits, lowered to those of the server."""
        s = self._settings
        for name, unit in _REAL_LIMITS.items():
            if not 0 <= getattr(requested, name) < math.inf:
                raise InvalidArgument(
                    field=f"limits.{name}", expected=f"a positive number of {unit}", got=f"{getattr(requested, name):g}"
                )
        idle = min(requested.idle_timeout or s.idle_timeout, s.idle_timeout)
        return pb.SessionLimits(
            max_points=min(requested.max_points or s.max_points, s.max_points),
            max_frame_rate=_smaller_bound(requested.max_frame_rate, s.max_frame_rate),
            idle_timeout=idle,
            max_lifetime=_smaller_bound(requested.max_lifetime, s.max_lifetime),
            max_frames_in_flight=min(requested.max_frames_in_flight or s.lossless_queue, s.lossless_queue),
            departure_timeout=min(requested.departure_timeout or s.departure_timeout, idle),
        )

    def flow_mode(self, requested: pb.FlowMode) -> pb.FlowMode:
        """The flow mode of a stream: the requested one, else the server's default."""
        if requested not in pb.FlowMode.values():
            raise InvalidArgument(field="flow_mode", expected="realtime or lossless", got=f"unknown value {requested}")
        if requested != pb.FLOW_MODE_UNSPECIFIED:
            return requested
        return pb.FLOW_MODE_LOSSLESS if self._settings.default_flow == "lossless" else pb.FLOW_MODE_REALTIME

    def memory_estimate(self, request: pb.CreateSessionRequest | pb.RestoreSessionRequest) -> Memory:
        """Estimated memory of a session before its meshes or its snapshot are decoded."""
        if isinstance(request, pb.RestoreSessionRequest):
            return Memory(_RESTORED_BYTES_PER_SNAPSHOT_BYTE * len(request.data), 0)
        counts = []
        for mesh in (request.session.garment, request.session.body):
            double = mesh.vertices.encoding == pb.ARRAY_ENCODING_FLOAT64
            counts += [len(mesh.vertices.data) // (24 if double else 12), len(mesh.faces.data) // 12]
        return Memory.of(*counts, self.limits(request.session.limits).max_points)


def _require_below(maximum: int, count: int, holder: str) -> None:
    if count >= maximum:
        raise ResourceExhausted(
            f"sessions: {holder} has its {maximum} already; try again later or delete one", retry_after=_RETRY_WHEN_FULL
        )


def session_id(requested: str) -> str:
    """The requested id, or a random one."""
    if not requested:
        return "s-" + secrets.token_hex(8)
    if not is_session_id(requested):
        raise InvalidArgument(field="session_id", expected="4-63 of [a-z0-9-] beginning with a letter", got=repr(requested[:80]))
    return requested


def labels(session: pb.Session) -> dict[str, str]:
    """The requested labels."""
    requested = dict(session.labels)
    if len(requested) > _MAX_LABELS:
        raise InvalidArgument(field="labels", expected=f"at most {_MAX_LABELS}", got=str(len(requested)))
    if "" in requested:
        raise InvalidArgument(field="labels", expected="a key for each value", got=f"an empty key for {requested[''][:80]!r}")
    longest = max((len(text) for pair in requested.items() for text in pair), default=0)
    if longest > _MAX_TEXT:
        raise InvalidArgument(field="labels", expected=f"at most {_MAX_TEXT} characters each", got=str(longest))
    return requested


def require_no_name(session: pb.Session) -> None:
    """Rejects a new session with a name: ``session_id`` chooses it, and another one would be a surprise."""
    if session.name:
        expected = "nothing; session_id chooses the name"
        raise InvalidArgument(field="session.name", expected=expected, got=repr(session.name[:80]))


def require_request_id(request_id: str) -> None:
    """Rejects an invalid request id. PostgreSQL stores no NUL in a text."""
    if len(request_id) > _MAX_TEXT:
        raise InvalidArgument(field="request_id", expected=f"at most {_MAX_TEXT} characters", got=str(len(request_id)))
    if "\0" in request_id:
        raise InvalidArgument(field="request_id", expected="text without NUL", got=repr(request_id[:80]))


def _smaller_bound(requested: float, maximum: float) -> float:
    """The smaller of two bounds; 0 means not bounded."""
    return min(requested or maximum, maximum or requested)

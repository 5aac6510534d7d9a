"""Session record: one session's row in the registry."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field

from ddakf_api.v1 import tracking_pb2 as pb


def new_uid() -> int:
    """A random number for a session: unlike its id, never used again."""
    return secrets.randbits(63)


@dataclass(frozen=True)
class SessionRecord:
    """A session in the registry.

    Attributes:
        server_id: of the session's server.
        session: the session without its meshes: name, state, labels, limits, configuration, fabric, counts, vertex map,
            times, statistics, etag. Not to be changed after it is saved.
        request_id: of the creation, if any.
        owner: id of the key that created the session; None: no key was needed.
        uid: see :func:`new_uid`.
        reason: of the session's end; None while it is live.
        end_time: seconds since 1970; None while it is live.
        epoch: of the session's lease; 0: the server does not share its sessions.
    """

    server_id: str
    session: pb.Session
    request_id: str = ""
    uid: int = field(default_factory=new_uid)
    reason: pb.ErrorDetail | None = None
    end_time: float | None = None
    owner: str | None = None
    epoch: int = 0

    @property
    def id(self) -> str:
        return self.session.name.removeprefix("sessions/")

    @property
    def create_time(self) -> float:
        """Seconds since 1970."""
        return self.session.create_time.ToNanoseconds() / 1e9

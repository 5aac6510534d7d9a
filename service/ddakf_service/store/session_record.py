"""Session record: one session as the registry stores it."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field

from ddakf_api.v1 import tracking_pb2 as pb


def new_uid() -> int:
    """A number that no other session has: ids can be used again, this never is."""
    return secrets.randbits(63)


@dataclass(frozen=True)
class SessionRecord:
    """A session as it is registered.

    Attributes:
        server_id: of the server that has it.
        session: the resource without its meshes: name, state, labels, limits, configuration, fabric, counts, vertex map,
            times, statistics, etag. Whoever saves it leaves it alone afterwards.
        request_id: the one that it was created with, if any.
        owner: the key that it was created with; None: none was needed.
        uid: see :func:`new_uid`.
        reason: why it is no more; None while it lives.
        end_time: when it ended, seconds since 1970; None while it lives.
    """

    server_id: str
    session: pb.Session
    request_id: str = ""
    uid: int = field(default_factory=new_uid)
    reason: pb.ErrorDetail | None = None
    end_time: float | None = None
    owner: str | None = None

    @property
    def id(self) -> str:
        return self.session.name.removeprefix("sessions/")

    @property
    def create_time(self) -> float:
        """Seconds since 1970."""
        return self.session.create_time.ToNanoseconds() / 1e9

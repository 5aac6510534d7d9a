"""Principal: the caller's key id and scopes, and the access that they give to a session."""

from __future__ import annotations

import enum
from contextvars import ContextVar
from dataclasses import dataclass


class Scope(enum.StrEnum):
    """Permission of a key.

    STREAM: create, stream to, change and delete the key's own sessions. READ: sessions, statistics and history of all keys,
    and metrics. ADMIN: everything, on all sessions.
    """

    STREAM = "stream"
    READ = "read"
    ADMIN = "admin"


@dataclass(frozen=True)
class Principal:
    """The caller.

    Attributes:
        id: of the key, the owner of its sessions; empty: no key.
        scopes: of the key.
        max_sessions: quota of the key; 0: the server's setting.
        frames_per_second: of all its streams together; 0: not limited.
        requests_per_minute: calls of the key, streams included; 0: not limited.
    """

    id: str
    scopes: frozenset[Scope]
    max_sessions: int = 0
    frames_per_second: float = 0.0
    requests_per_minute: float = 0.0

    def allows(self, scope: Scope) -> bool:
        return scope in self.scopes or Scope.ADMIN in self.scopes

    def may_read(self, owner: str | None) -> bool:
        """Whether the caller may read a session. ``owner`` None: it was created without a key."""
        return self.allows(Scope.READ) or (self.id == owner and self.allows(Scope.STREAM))

    def may_change(self, owner: str | None) -> bool:
        """Whether the caller may use and change a session; ``owner`` as in :meth:`may_read`."""
        return Scope.ADMIN in self.scopes or (self.id == owner and self.allows(Scope.STREAM))


ANONYMOUS = Principal("", frozenset(Scope))
"""Any caller, where no key is needed."""

STRANGER = Principal("", frozenset())
"""A caller without a key where one is needed, in a call that is open to all."""

current_principal: ContextVar[Principal] = ContextVar("current_principal", default=ANONYMOUS)
"""Caller of the present call, set by the guards."""

"""Whoever makes a call, and what they may do with sessions."""

from __future__ import annotations

import enum
from contextvars import ContextVar
from dataclasses import dataclass


class Scope(enum.StrEnum):
    """What a key allows.

    STREAM: sessions of one's own, created, streamed to, changed and deleted. READ: sessions, statistics and history of
    everyone, metrics. ADMIN: everything, on everyone's sessions.
    """

    STREAM = "stream"
    READ = "read"
    ADMIN = "admin"


@dataclass(frozen=True)
class Principal:
    """Who makes a call.

    Attributes:
        id: of the key; sessions belong to it. Empty: nobody in particular.
        scopes: of the key.
        max_sessions: that it may have at a time; 0: the server's bound alone.
    """

    id: str
    scopes: frozenset[Scope]
    max_sessions: int = 0

    def allows(self, scope: Scope) -> bool:
        return scope in self.scopes or Scope.ADMIN in self.scopes

    def may_read(self, owner: str | None) -> bool:
        """A session of ``owner``; None: it was made where no key was asked for."""
        return self.allows(Scope.READ) or (self.id == owner and self.allows(Scope.STREAM))

    def may_change(self, owner: str | None) -> bool:
        """As :meth:`may_read`."""
        return Scope.ADMIN in self.scopes or (self.id == owner and self.allows(Scope.STREAM))


ANONYMOUS = Principal("", frozenset(Scope))
"""Anyone, where no key is asked for."""

current_principal: ContextVar[Principal] = ContextVar("current_principal", default=ANONYMOUS)
"""Set by the guards for the length of a call."""

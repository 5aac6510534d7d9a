"""Tenure: the time until which this server may answer for its sessions, where several servers share them."""

from __future__ import annotations

import asyncio
import math
from time import monotonic

from ddakf_api.errors import Unavailable

from ..session import Session

_LOOK_INTERVAL = 0.05  # seconds


class Tenure:
    """Ends when the leases of this server do; without leases never.

    Attributes:
        until: monotonic clock, seconds.
    """

    def __init__(self):
        self.until = math.inf

    @property
    def held(self) -> bool:
        return monotonic() < self.until

    async def wait(self, session: Session, timeout: float = math.inf) -> None:
        """Returns when this server may answer for a session.

        Raises:
            Unavailable: the session has gone to another server, or the leases were not renewed in ``timeout`` seconds.
        """
        deadline = monotonic() + timeout
        while not (self.held or session.closed):
            if monotonic() > deadline:
                raise Unavailable(f"the lease of {session.name} cannot be renewed now; try again later", retry_after=1.0)
            await asyncio.sleep(_LOOK_INTERVAL)
        if session.closed:
            raise Unavailable(f"{session.name} has ended, or has gone to another server")

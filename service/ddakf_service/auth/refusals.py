"""Refusals: calls that are not admitted, counted by reason, with a line of the log now and then."""

from __future__ import annotations

import logging
import math
from time import monotonic

from ddakf_api.errors import PermissionDenied, ResourceExhausted, ServiceError, Unauthenticated
from prometheus_client import Counter

from .keys import id_of

log = logging.getLogger(__name__)

_LOG_INTERVAL = 10.0  # seconds between two lines of a reason; anyone may send thousands of calls per second
_BY_ERROR = {Unauthenticated: "invalid_key", PermissionDenied: "scope", ResourceExhausted: "rate"}
FOREIGN_PAGE = "origin"


class Refusals:
    """Counts refused calls by reason, and logs them.

    Args:
        counter: with a label for the reason.
    """

    def __init__(self, counter: Counter):
        self._counter = counter
        self._unlogged: dict[str, int] = {}
        self._logged_at: dict[str, float] = {}

    def record(self, error: ServiceError, presented_key: str | None, call: str, peer: str, reason: str = "") -> None:
        """Records a refused call.

        Args:
            call: method and path, printable.
            peer: address of the caller, or of its proxy.
            reason: empty: what the error says.
        """
        reason = reason or _reason(error, presented_key)
        self._counter.labels(reason).inc()
        count = self._unlogged[reason] = self._unlogged.get(reason, 0) + 1
        if monotonic() - self._logged_at.get(reason, -math.inf) >= _LOG_INTERVAL:
            self._logged_at[reason], self._unlogged[reason] = monotonic(), 0
            fields = {"reason": reason, "calls": count, "call": call, "peer": peer, "key": id_of(presented_key or "") or "-"}
            log.warning("a call was refused: %s", error, extra=fields)


def _reason(error: ServiceError, presented_key: str | None) -> str:
    """Label of a refusal by the guard."""
    if presented_key is None:
        return "no_key"
    return _BY_ERROR.get(type(error), "unread_keys")

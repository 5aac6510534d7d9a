"""Condition of a part of the store: a metric at every failure, a log line at every change."""

from __future__ import annotations

import logging

from prometheus_client import Counter, Gauge
from sqlalchemy.exc import DBAPIError

log = logging.getLogger(__name__)

_LONGEST = 300  # characters of an error in a message


class Condition:
    """The condition of one part ("database", "checkpoints"). Any thread may call.

    Args:
        up, errors: metrics with a label for the part.

    Attributes:
        problem: one sentence while the part fails; empty while it works.
    """

    def __init__(self, part: str, up: Gauge, errors: Counter):
        self.part = part
        self.problem = ""
        self._up, self._errors = up.labels(part), errors.labels(part)
        self._up.set(1)

    def works(self) -> None:
        if self.problem:
            self.problem = ""
            self._up.set(1)
            log.info("the %s can be written again", self.part, extra={"part": self.part})

    def fails(self, error: Exception) -> None:
        self._errors.inc()
        before, self.problem = self.problem, f"the {self.part} cannot be reached or written: {sentence_of(error)}"
        self._up.set(0)
        if not before:
            log.error("%s; tracking continues, and the server tries again", self.problem, extra={"part": self.part})


def sentence_of(error: Exception) -> str:
    """First line of an error's message, without SQL and values."""
    cause = error.orig if isinstance(error, DBAPIError) and error.orig else error
    return (str(cause).strip().partition("\n")[0] or type(cause).__name__)[:_LONGEST]

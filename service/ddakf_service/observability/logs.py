"""Logs: one line of text or one JSON object per event, with its session's id."""

from __future__ import annotations

import json
import logging
import sys
import time
from contextvars import ContextVar

# Id of the session that the present task works for; every log line carries it.
current_session: ContextVar[str] = ContextVar("current_session", default="-")


_PLAIN_FIELDS = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName", "session"}


class FailureLog:
    """Lines about something that is tried again and again: one when it begins to fail, one when it works again.

    Args:
        log: their logger.
        failing: first part of the first line, before the reason.
        working: the last line.
    """

    def __init__(self, log: logging.Logger, failing: str, working: str):
        self._log, self._failing_line, self._working_line = log, failing, working
        self._failing = False

    def fails(self, reason: object) -> None:
        if not self._failing:
            self._failing = True
            self._log.error("%s: %s", self._failing_line, reason)

    def works(self) -> None:
        if self._failing:
            self._failing = False
            self._log.info(self._working_line)


def configure_logging(level: str, format: str) -> None:
    """Writes all logs from ``level`` upward to standard error as ``text`` or ``json`` lines."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if format == "json" else TextFormatter())
    handler.addFilter(_add_session)
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    # The service logs its own start and stop. OpenTelemetry would warn of every dropped span.
    for chatty, lowest in (("uvicorn", logging.WARNING), ("alembic", logging.WARNING), ("opentelemetry", logging.ERROR)):
        logging.getLogger(chatty).setLevel(max(lowest, root.level))


def _add_session(record: logging.LogRecord) -> bool:
    if not hasattr(record, "session"):
        record.session = current_session.get()
    return True


def _fields(record: logging.LogRecord) -> dict:
    """The fields given with the line. Those that begin with ``_`` are a library's own: Ray adds one to every record."""
    return {k: v for k, v in vars(record).items() if k not in _PLAIN_FIELDS and not k.startswith("_")}


class TextFormatter(logging.Formatter):
    def __init__(self):
        super().__init__("%(asctime)s %(levelname)-7s %(session)s %(message)s")

    def formatMessage(self, record):
        fields = "".join(f" {key}={value}" for key, value in _fields(record).items())
        return super().formatMessage(record) + fields


class JsonFormatter(logging.Formatter):
    def format(self, record):
        line = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "session": record.session,
            "message": record.getMessage(),
            **_fields(record),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)

"""Rows of trials in a file that grows line by line, so that an interrupted study goes on where it was."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from ddakf.errors import InvalidFile
from ddakf.evaluation.trials.trial import Trial


class RowLog:
    """A file of rows, one JSON object per line.

    Args:
        path: the file; made when the first row is written.

    Raises:
        InvalidFile: it holds something else.
    """

    def __init__(self, path: Path):
        self.path = path
        self._rows: dict[Trial, dict] = {}
        *lines, rest = path.read_bytes().split(b"\n") if path.is_file() else [b""]
        self._cut_off = len(rest)  # bytes of a line that was not written to its end; they go before the next row comes
        for number, line in enumerate(lines, 1):
            try:
                row = json.loads(line)
                self._rows[Trial.of(row)] = row
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                raise InvalidFile(f"{path}, line {number}", "a row of a study", f"{line[:40]!r}") from error

    def done(self, trial: Trial) -> bool:
        """It was run; one that failed is run again."""
        return trial in self._rows and "failed" not in self._rows[trial]

    def current(self, trial: Trial, code: str) -> bool:
        """It was run by this code, see :func:`ddakf.evaluation.machine.code`, and applied. Of changed files nobody knows."""
        row = self._rows.get(trial, {"failed": ""})
        return not {"failed", "not_applicable"} & set(row) and row.get("commit") == code and not code.endswith("-dirty")

    def rows(self, trials: list[Trial] | None = None) -> list[dict]:
        """Of those trials that were run, in their order; None: all rows."""
        chosen = self._rows if trials is None else [trial for trial in trials if trial in self._rows]
        return [complete(self._rows[trial]) for trial in chosen]

    def add(self, row: dict) -> None:
        """Writes a row; it takes the place of an older one of the same trial, which stays in the file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab") as file:
            file.truncate(file.tell() - self._cut_off)
            file.write(json.dumps(row).encode() + b"\n")
        self._cut_off = 0
        self._rows[Trial.of(row)] = row


def complete(row: dict) -> dict:
    """A row with the fields of a trial that were not there when it was written."""
    return asdict(Trial.of(row)) | row

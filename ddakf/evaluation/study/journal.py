"""Rows of trials in a file that grows line by line, so that an interrupted study goes on where it was."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from ddakf.errors import InvalidFile
from ddakf.evaluation.trials import Trial


class Journal:
    """A file of rows, one JSON object per line.

    Args:
        path: the file; made when the first row is written.

    Raises:
        InvalidFile: it holds something else.
    """

    def __init__(self, path: Path):
        self.path = path
        self._rows: dict[Trial, dict] = {}
        lines = path.read_bytes().split(b"\n") if path.is_file() else []
        for number, line in enumerate(lines, 1):
            if not line:
                continue
            try:
                row = json.loads(line)
                trial = Trial.of(row)
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                if number == len(lines):  # cut off while it was written
                    self._cut(len(line))
                    break
                raise InvalidFile(f"{path}, line {number}", "a row of a study", f"{line[:40]!r}") from error
            self._rows[trial] = row

    def _cut(self, count: int) -> None:
        with self.path.open("rb+") as file:
            file.truncate(self.path.stat().st_size - count)

    def done(self, trial: Trial) -> bool:
        """It was run; one that failed is run again."""
        return trial in self._rows and "failed" not in self._rows[trial]

    def rows(self, trials: list[Trial]) -> list[dict]:
        """Of those trials that were run, in their order."""
        return [self._rows[trial] for trial in trials if trial in self._rows]

    def add(self, row: dict) -> None:
        """Writes a row."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as file:
            file.write(json.dumps(row) + "\n")
        self._rows[Trial.of(row)] = row


def complete(row: dict) -> dict:
    """A row with the fields of a trial that were not there when it was written."""
    return asdict(Trial.of(row)) | row

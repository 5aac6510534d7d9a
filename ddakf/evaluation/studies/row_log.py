"""Row log: an append-only file of finished trials, from which an interrupted study resumes."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from ddakf.errors import InvalidFile
from ddakf.evaluation.trials.inputs import digest_of
from ddakf.evaluation.trials.trial import Trial


class RowLog:
    """A file of rows, one JSON object per line.

    Args:
        path: of the file, which the first row creates.
        earlier: rows of trials that were run elsewhere, for those that the file lacks.
        append: they are appended to the file.

    Raises:
        InvalidFile: a line that is no row.
    """

    def __init__(self, path: Path, earlier: Iterable[dict] = (), *, append: bool = True):
        self.path = path
        self._rows: dict[Trial, dict] = {}
        data = path.read_bytes() if path.is_file() else b""
        *lines, rest = data.split(b"\n")
        self._size, self._cut_off = len(data), len(rest)  # bytes; those of an incomplete last line, which the next row overwrites
        for number, line in enumerate(lines, 1):
            try:
                row = json.loads(line)
                self._rows[Trial.from_row(row)] = row
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                raise InvalidFile(f"{path}, line {number}", "a row of a study", f"{line[:40]!r}") from error
        for row in earlier:
            if self.done(Trial.from_row(row)):
                continue
            if append:
                self.add(row)
            else:
                self._rows[Trial.from_row(row)] = row

    def done(self, trial: Trial) -> bool:
        """True if the trial was run and did not fail."""
        return trial in self._rows and "failed" not in self._rows[trial]

    def outdated(self, trial: Trial) -> bool:
        """True if the trial was run with another content of its inputs, see :func:`.trials.inputs.digest_of`."""
        row = self._rows.get(trial, {})
        return "inputs" in row and row["inputs"] != digest_of(trial)

    def current(self, trial: Trial, code: str) -> bool:
        """True if the trial applied and was run by this version, see :func:`ddakf.evaluation.machine.code_version`. Never true
        of a modified checkout."""
        row = self._rows.get(trial, {"failed": ""})
        return not {"failed", "not_applicable"} & set(row) and row.get("commit") == code and not code.endswith("-dirty")

    def rows(self, trials: list[Trial] | None = None) -> list[dict]:
        """The rows of those trials that were run, in their order; None for all rows."""
        chosen = self._rows if trials is None else [trial for trial in trials if trial in self._rows]
        return [complete(self._rows[trial]) for trial in chosen]

    def take_over(self, trials: list[Trial], other: RowLog) -> int:
        """Adds the other log's rows of those trials that were not run here; how many those are."""
        taken = [trial for trial in trials if other.done(trial) and not self.done(trial)]
        for trial in taken:
            self.add(other._rows[trial])
        return len(taken)

    def add(self, row: dict) -> None:
        """Appends a row. It replaces an older one of the same trial, which stays in the file.

        Raises:
            InvalidFile: another process has written to the file.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab") as file:
            if file.tell() != self._size:
                raise InvalidFile(str(self.path), "one run at a time that writes to it", "another one; wait for its end")
            file.truncate(self._size - self._cut_off)
            file.write(json.dumps(row).encode() + b"\n")
            self._size, self._cut_off = file.tell(), 0
        self._rows[Trial.from_row(row)] = row


def complete(row: dict) -> dict:
    """A row with the defaults of the trial's fields that it lacks, as an older version wrote it."""
    return asdict(Trial.from_row(row)) | row

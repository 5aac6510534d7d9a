"""Markdown tables of the report, written between two marks of a document. The text outside the marks stays."""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path
from textwrap import fill

from ddakf.errors import InvalidFile
from ddakf.evaluation.reporting.paper_tables import Cell, Table
from ddakf.evaluation.reporting.result_files import UNTRACEABLE

BEGIN, END = "<!-- ddakf report: begin -->", "<!-- ddakf report: end -->"
MARK = re.compile(r"<!-- ddakf report: begin((?: [\w+-]+)*) -->")  # with the names of the tables that a document wants

LINES = partial(fill, width=100, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def rewritten(path: Path, tables: list[Table], results: Path) -> str:
    """The document with these tables between its marks, or with those alone that its first mark names, in that order.

    Args:
        path: of the document.
        tables: to choose from.
        results: folder of the files that the tables link to.

    Raises:
        InvalidFile: no document with both marks.
    """
    text = path.read_text() if path.is_file() else ""
    begin = MARK.search(text)
    _, end, after = text[begin.end() :].partition(END) if begin else ("", "", "")
    if not end:
        raise InvalidFile(str(path), f"a document with {BEGIN} and {END}", "none")
    by_name, said = {table.name: table for table in tables}, set()
    names = [name for name in begin[1].split() if name in by_name] or ([] if begin[1].split() else list(by_name))
    sections = [section(by_name[name], os.path.relpath(results, path.parent), said) for name in names]
    return text[: begin.end()] + "\n\n" + "\n\n".join(sections) + "\n\n" + END + after


def section(table: Table, folder: str | Path, said: set[str] | None = None) -> str:
    """A table under its title, with the notes that no table before it had (``said``), and links to its results in a folder."""
    said = set() if said is None else said
    words = [k == 0 or any(row[k].kind == "text" for row in table.rows) for k in range(len(table.heads))]
    lines = [table.heads, ["---" if left else "--:" for left in words], *([_text(cell) for cell in row] for row in table.rows)]
    body = "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
    new = [note for note in table.notes if note not in said]
    said.update(new)
    new = [f"**{note}**" if UNTRACEABLE in note else note for note in new]
    notes = "\n" * bool(new) + "".join("\n" + LINES(f"- {note}") for note in new)
    files = ", ".join(f"[{source.name}.json]({Path(folder, source.name).as_posix()}.json)" for source in table.sources)
    return f"## {table.title}\n\n{body}{notes}" + ("\n\n" + LINES(f"From {files}.") if files else "")


def _text(cell: Cell) -> str:
    text = cell.text.replace("|", "\\|")
    return f"**{text}**" if cell.kind == "best" else f"_{text}_" if cell.kind == "paper" and text != "–" else text

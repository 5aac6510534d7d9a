"""Markdown tables of the report, written between two marks of a document. The text outside the marks stays."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from textwrap import fill

from ddakf.errors import InvalidFile
from ddakf.evaluation.reporting.paper_tables import Cell, Table

BEGIN, END = "<!-- ddakf report: begin -->", "<!-- ddakf report: end -->"
MARK = re.compile(r"<!-- ddakf report: begin((?: [\w+-]+)*) -->")  # with the names of the tables that a document wants

LINES = partial(fill, width=100, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def rewritten(path: Path, tables: list[Table]) -> str:
    """The document with these tables between its marks, or with those alone that its first mark names.

    Raises:
        InvalidFile: no document with both marks.
    """
    text = path.read_text() if path.is_file() else ""
    begin = MARK.search(text)
    _, end, after = text[begin.end() :].partition(END) if begin else ("", "", "")
    if not end:
        raise InvalidFile(str(path), f"a document with {BEGIN} and {END}", "none")
    names, said = begin[1].split(), set()
    sections = [_section(table, said) for table in tables if not names or table.name in names]
    return text[: begin.end()] + "\n\n" + "\n\n".join(sections) + "\n\n" + END + after


def _section(table: Table, said: set[str]) -> str:
    """A table under its title, with the notes that no table before it had."""
    words = [k == 0 or any(row[k].kind == "text" for row in table.rows) for k in range(len(table.heads))]
    lines = [table.heads, ["---" if left else "--:" for left in words], *([_text(cell) for cell in row] for row in table.rows)]
    body = "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
    new = [note for note in table.notes if note not in said]
    said.update(new)
    notes = "\n" * bool(new) + "".join("\n" + LINES(f"- {note}") for note in new)
    files = ", ".join(f"[{source.name}.json](../results/{source.name}.json)" for source in table.sources)
    return f"## {table.title}\n\n{body}{notes}" + ("\n\n" + LINES(f"From {files}.") if files else "")


def _text(cell: Cell) -> str:
    text = cell.text.replace("|", "\\|")
    return f"**{text}**" if cell.kind == "best" else f"_{text}_" if cell.kind == "paper" and text != "–" else text

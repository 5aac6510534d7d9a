"""Tables of the report as Markdown, between two marks of a document whose other text is a person's."""

from __future__ import annotations

from pathlib import Path

from ddakf.errors import InvalidFile
from ddakf.evaluation.reporting.paper_tables import Cell, Table

BEGIN, END = "<!-- ddakf report: begin -->", "<!-- ddakf report: end -->"


def rewritten(path: Path, tables: list[Table]) -> str:
    """The document with these tables between its marks.

    Raises:
        InvalidFile: no document with both marks.
    """
    text = path.read_text() if path.is_file() else ""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise InvalidFile(str(path), f"a document with {BEGIN} and {END}", "none")
    said: set[str] = set()
    sections = [_section(table, said) for table in tables]
    return before + BEGIN + "\n\n" + "\n\n".join(sections) + "\n\n" + END + after


def _section(table: Table, said: set[str]) -> str:
    """A table under its title, with the notes that no table before it had."""
    words = [k == 0 or any(row[k].kind == "text" for row in table.rows) for k in range(len(table.heads))]
    lines = [table.heads, ["---" if left else "--:" for left in words], *([_text(cell) for cell in row] for row in table.rows)]
    body = "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
    new = [note for note in table.notes if note not in said]
    said.update(new)
    notes = "\n" * bool(new) + "".join(f"\n- {note}" for note in new)
    files = ", ".join(f"[{source.name}.json](../results/{source.name}.json)" for source in table.sources)
    return f"## {table.title}\n\n{body}{notes}" + (f"\n\nFrom {files}." if files else "")


def _text(cell: Cell) -> str:
    """A cell's text; the paper's numbers without their deviations, which the page has."""
    text = cell.text.replace("|", "\\|")
    if cell.kind == "paper" and text != "–":
        return f"_{text.partition(' ±')[0]}_"
    return f"**{text}**" if cell.kind == "best" else text

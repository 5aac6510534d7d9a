"""Tables of the commands: whole cells, whatever the width of the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

_WIDE = 1000  # characters of a line


def printable(text: str) -> str:
    """The text with escapes in place of line breaks, controls of a terminal and other characters that show nothing."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def print_table(columns: Sequence[str], rows: Iterable[Iterable[str]]) -> None:
    """Prints a table, a row a line, whatever is in the cells. Ids and times have to be whole: a narrow terminal breaks lines."""
    table = Table(box=None, header_style="bold")
    for column in columns:
        table.add_column(column, no_wrap=True)
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    Console(highlight=False, width=_WIDE).print(table)

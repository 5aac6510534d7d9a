"""Tables of the commands: whole cells, whatever the width of the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table

_WIDE = 1000  # characters of a line


def print_table(columns: Sequence[str], rows: Iterable[Iterable[str]]) -> None:
    """Prints a table. Ids and times have to be whole: a narrow terminal breaks lines instead."""
    table = Table(box=None, header_style="bold")
    for column in columns:
        table.add_column(column, no_wrap=True)
    for row in rows:
        table.add_row(*row)
    Console(highlight=False, width=_WIDE).print(table)

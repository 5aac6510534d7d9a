"""Tables of the commands: what others wrote into a cell stays in it."""

import pytest

from ddakf.commands.tables import print_table


@pytest.mark.parametrize(
    ("cell", "shown"),
    [
        ("a\x1b[31mb\x1b]0;title\x07", r"a\x1b[31mb\x1b]0;title\x07"),
        ("a\nforged  idle  0", r"a\nforged  idle  0"),
        ("a\r\x08b\u202eb\x9b2J", r"a\r\x08b\u202eb\x9b2J"),
        ("[bold]a[/bold] [/none] :smile:", "[bold]a[/bold] [/none] :smile:"),
        ("Größe=größer, 衣", "Größe=größer, 衣"),
    ],
)
def test_a_cell_is_shown_as_it_is_and_a_row_is_a_line(capsys, cell, shown):
    print_table(("id", "labels"), [("one", cell), ("two", "x")])
    head, first, second = capsys.readouterr().out.splitlines()
    assert (head.split(), second.split()) == (["id", "labels"], ["two", "x"])
    assert first.strip().split(maxsplit=1) == ["one", shown]

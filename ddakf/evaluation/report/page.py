"""The report as one HTML page beside its pictures."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

from ddakf.evaluation.report.results import Result
from ddakf.evaluation.report.tables import Cell, Table

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #23262e; max-width: 1180px; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin: 2.4rem 0 .5rem; border-top: 1px solid #e2e4e9; padding-top: 1.2rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .86rem; }
th { text-align: right; vertical-align: bottom; font-weight: 600; padding: .3rem .6rem; border-bottom: 2px solid #23262e; }
th:first-child, td:first-child { position: sticky; left: 0; background: #fff; }
th:first-child, td:first-child, .names td:nth-child(2), .names th:nth-child(2) { text-align: left; }
td { text-align: right; padding: .22rem .6rem; border-bottom: 1px solid #eceef2; white-space: nowrap; }
td.best { font-weight: 700; } td.paper, th.paper { color: #7a6a4f; background: #faf7f0; } td.none { color: #999; }
.notes, .source { font-size: .82rem; color: #555b68; } .notes { padding-left: 1.1rem; } img { max-width: 100%; }
figure { margin: 1rem 0; } figcaption { font-size: .86rem; color: #555b68; } code { font-size: .85em; }
"""


@dataclass
class Picture:
    """A figure of the report.

    Attributes:
        name: of its file, without folder.
        title: above it.
        caption: below it.
        source: what it was drawn from.
    """

    name: str
    title: str
    caption: str
    source: str


def page(title: str, introduction: list[str], parts: list[Table | Picture], results: list[Result]) -> str:
    """HTML of the report.

    Args:
        title: of the page.
        introduction: paragraphs.
        parts: in their order.
        results: that it is made of, for the list of sources.
    """
    body = [f"<h1>{escape(title)}</h1>"] + [f"<p>{escape(text)}</p>" for text in introduction]
    for part in parts:
        body.append(_table(part) if isinstance(part, Table) else _picture(part))
    body.append("<h2>Where the numbers come from</h2>" + _sources(results))
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>\n<body>\n'
        + "\n".join(body) + "\n</body></html>\n"
    )  # fmt: skip


def _table(table: Table) -> str:
    heads = "".join(f'<th{" class=paper" if head == "in the paper" else ""}>{escape(head)}</th>' for head in table.heads)
    rows = "\n".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in table.rows)
    notes = "".join(f"<li>{escape(note)}</li>" for note in table.notes)
    names = ' class="names"' if table.heads[1] in ("system", "view", "sequence") else ""
    files = ", ".join(f'<a href="#{escape(result.name)}">{escape(result.name)}.json</a>' for result in table.sources)
    return (
        f'<h2 id="{escape(table.name)}">{escape(table.title)}</h2>\n<div class="wide"><table{names}>'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>{rows}</tbody></table></div>"
        + (f'<ul class="notes">{notes}</ul>' if notes else "") + f'<p class="source">From {files}.</p>'
    )  # fmt: skip


def _cell(cell: Cell) -> str:
    kind = f' class="{cell.kind}"' if cell.kind else ""
    note = f' title="{escape(cell.note)}"' if cell.note else ""
    return f"<td{kind}{note}>{escape(cell.text)}</td>"


def _picture(picture: Picture) -> str:
    name, title = escape(picture.name), escape(picture.title)
    return (
        f'<h2 id="{name}">{title}</h2>\n<figure><img src="{name}" alt="{title}">'
        f"<figcaption>{escape(picture.caption)} From {escape(picture.source)}.</figcaption></figure>"
    )


def _sources(results: list[Result]) -> str:
    rows = []
    for result in results:
        meta, machine = result.meta, result.meta["machine"]
        packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items() if version)
        conditions = ", ".join(f"{name} {value}" for name, value in meta["conditions"].items() if value != "")
        rows.append(
            f'<tr id="{escape(result.name)}"><td>{escape(result.name)}.json</td><td style="white-space:normal;text-align:left">'
            f"<code>{escape(meta['command'])}</code><br>{escape(meta['date'])}, commits {escape(', '.join(meta['commits']))}; "
            f"seeds {escape(', '.join(map(str, meta['seeds'])))}; frames {escape(meta['frames'])}; {escape(conditions)}; "
            f"{escape(str(machine['cpu']))}, {machine['cores']} cores, {machine['processes']} processes, "
            f"load {machine['load_average']}; "
            f"Python {escape(machine['python'])}; {escape(packages)}</td></tr>"
        )
    return f'<div class="wide"><table><tbody>{"".join(rows)}</tbody></table></div>'

"""The report as one HTML page beside its pictures."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

from ddakf.evaluation.reporting.paper_tables import Cell, Table
from ddakf.evaluation.reporting.result_files import UNTRACEABLE, Result

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #23262e; margin: 2rem max(1.2rem, (100vw - 1800px) / 2); }
p, nav, ul, figure { max-width: 1180px; } nav { columns: 2; font-size: .86rem; } nav a { display: block; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin: 2.4rem 0 .5rem; border-top: 1px solid #e2e4e9; padding-top: 1.2rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .86rem; }
th { text-align: right; vertical-align: bottom; font-weight: 600; padding: .3rem .6rem; border-bottom: 2px solid #23262e; }
th:first-child, td:first-child { position: sticky; left: 0; background: #fff; }
th:first-child, td:first-child, .names td:nth-child(2), .names th:nth-child(2) { text-align: left; }
td { text-align: right; padding: .22rem .6rem; border-bottom: 1px solid #eceef2; white-space: nowrap; }
td.best { font-weight: 700; } td.paper, th.paper { color: #7a6a4f; background: #faf7f0; } td.none { color: #999; }
td.text { text-align: left; white-space: normal; max-width: 800px; }
.notes, .source { font-size: .82rem; color: #555b68; } .notes { padding-left: 1.1rem; } img { max-width: 100%; }
.warning { color: #c00; font-weight: 700; }
figure { margin: 1rem 0; } figcaption { font-size: .86rem; color: #555b68; } code { font-size: .85em; }
"""


SOURCES = "Where the numbers come from"
SHARES = {"drop": "of the points dropped", "outliers": "of them outliers", "fliers": "of the edge pixels mixed"}
LENGTHS = {"depth_noise": "depth noise", "depth_step": "depth steps"}


@dataclass
class Picture:
    """A figure of the report.

    Attributes:
        name: of its file, without folder.
        title: above it.
        caption: below it.
        source: of its data.
    """

    name: str
    title: str
    caption: str
    source: str


def page(title: str, introduction: list[str], parts: list[Table | Picture], results: list[Result], folder: str) -> str:
    """HTML of the report.

    Args:
        title: of the page.
        introduction: paragraphs.
        parts: in their order.
        results: that it is made of, for the list of sources.
        folder: of their files, relative to the page.
    """
    body = [f"<h1>{escape(title)}</h1>"] + [f"<p>{escape(text)}</p>" for text in introduction] + [_contents(parts)]
    for part in parts:
        body.append(_table(part) if isinstance(part, Table) else _picture(part))
    body.append(f'<h2 id="sources">{SOURCES}</h2>' + _sources(results, folder))
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>\n<body>\n'
        + "\n".join(body) + "\n</body></html>\n"
    )  # fmt: skip


def _contents(parts: list[Table | Picture]) -> str:
    links = "".join(f'<a href="#{escape(part.name)}">{escape(part.title)}</a>' for part in parts)
    return f'<nav>{links}<a href="#sources">{SOURCES}</a></nav>'


def _table(table: Table) -> str:
    heads = "".join(f'<th{" class=paper" if head == "in the paper" else ""}>{escape(head)}</th>' for head in table.heads)
    rows = "\n".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in table.rows)
    notes = "".join(f"<li{' class=warning' if UNTRACEABLE in note else ''}>{escape(note)}</li>" for note in table.notes)
    names = ' class="names"' if table.heads[1] in ("system", "view", "sequence", "why") else ""
    files = ", ".join(f'<a href="#{escape(result.name)}">{escape(result.name)}.json</a>' for result in table.sources)
    return (
        f'<h2 id="{escape(table.name)}">{escape(table.title)}</h2>\n<div class="wide"><table{names}>'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>{rows}</tbody></table></div>"
        + (f'<ul class="notes">{notes}</ul>' if notes else "") + (f'<p class="source">From {files}.</p>' if files else "")
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


def _conditions(result: Result) -> str:
    """The settings of the sensor in words; settings of no effect are omitted."""
    given = result.meta["conditions"]
    if not any(run.get("rmse_mm") is not None for cell in result.cells for run in cell["runs"]):
        return "a real sensor's frames"
    parts = [f"{given['points']} points at most", f"noise {1e3 * given['noise']:g} mm"]
    parts += [f"{1e2 * given[name]:g} % {what}" for name, what in SHARES.items() if given.get(name)]
    parts += [f"{what} {1e3 * given[name]:g} mm at 1 m" for name, what in LENGTHS.items() if given.get(name)]
    if given.get("occlude"):
        first, end = given["occlude"]
        parts.append(f"{1e2 * given['occluded']:g} % of the garment hidden in frames {first} to {end - 1}")
    if not given.get("segmented", True):
        parts.append("body and garment in one cloud")
    if given.get("every", 1) > 1:
        parts.append(f"every {given['every']}. frame")
    return ", ".join(parts)


def _sources(results: list[Result], folder: str) -> str:
    rows = []
    for result in results:
        meta, machine = result.meta, result.meta["machine"]
        packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items() if version)
        file = f"{result.name}.json"
        sequences = ", ".join(result.sequences)
        frames = "all frames" if meta["frames"] == ":" else f"frames {meta['frames']}"
        rows.append(
            f'<tr id="{escape(result.name)}"><td><a href="{escape(folder)}/{escape(file)}">{escape(file)}</a></td>'
            f'<td class="text"><code>{escape(meta["command"])}</code><br>{escape(sequences)}; {escape(frames)}; '
            f"{escape(_conditions(result))}; seeds {escape(', '.join(map(str, meta['seeds'])))}<br>"
            f"{escape(meta['date'])}, commits {escape(', '.join(meta['commits']))}; "
            f"{escape(str(machine['cpu']))}, {machine['cores']} cores, {machine['processes']} processes, "
            f"load {machine['load_average']}; "
            f"Python {escape(machine['python'])}; {escape(packages)}</td></tr>"
        )
    return f'<div class="wide"><table><tbody>{"".join(rows)}</tbody></table></div>'

"""Hooks of the documentation site: pages that are generated, pages of other folders, and links between them.

Links in the documents are those of the repository. Here they lead to pages of the site; a link to a file that is no page
becomes plain text.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from pathlib import Path, PurePosixPath

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).parent))

from reference_pages import generated_pages  # noqa: E402, beside this file

COPIES = {
    "CHANGELOG.md": "changes.md",
    "clients/python/README.md": "clients/python.md",
    "clients/typescript/README.md": "clients/typescript.md",
    "protos/README.md": "reference/schema.md",
    "ddakf/data/README.md": "data/sample.md",
    "ddakf/data/training/README.md": "data/training.md",
    "benchmarks/recordings/README.md": "data/recordings.md",
}
"""Documents of other folders, and their places in the site."""
ELSEWHERE = {"examples": "examples.md", "README.md": "README.md"}
SOURCES = {place: source for source, place in COPIES.items()}

_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_ROLE = re.compile(r":(?:meth|class|func|mod|data|attr|exc):(<code>)~?(?:[\w]+\.)*(?=\w+</code>)")
_DIAGRAM = re.compile(r"^```mermaid\n(.*?)^```", re.S | re.M)
DIAGRAMS = Path(__file__).parent / "diagrams"
"""Diagrams by the hash of their text, drawn by `npm run diagrams` in clients/dashboard."""
_CODE = re.compile(r"(^```.*?^```)", re.S | re.M)


def on_files(files, config):
    """Adds the copies and the generated pages."""
    pages = {place: (ROOT / source).read_text() for source, place in COPIES.items()} | generated_pages(ROOT)
    for place, text in pages.items():
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turns the links of the repository into those of the site; code stays."""
    place = page.file.src_uri
    source = PurePosixPath(SOURCES.get(place, f"docs/{place}"))

    def replace(matched: re.Match) -> str:
        mark, words, target = matched.groups()
        if (mark and "](" in words) or re.match(r"[a-z]+:|#", target):
            return matched[0]
        path, hash_sign, anchor = target.partition("#")
        linked = os.path.normpath(source.parent / path)
        page_of_site = _place_of(linked, files)
        if page_of_site is None:
            return matched[0] if mark else words  # a picture that is not there fails the build
        relative = os.path.relpath(page_of_site, PurePosixPath(place).parent)
        return f"{mark}[{words}]({relative}{hash_sign}{anchor})"

    parts = _CODE.split(_DIAGRAM.sub(_drawn, markdown))
    return "".join(part if _CODE.fullmatch(part) else _LINK.sub(replace, part) for part in parts)


def on_page_content(html, page, config, files):
    """Leaves out the roles of Sphinx in docstrings."""
    return _ROLE.sub(r"\1", html)


def _drawn(matched: re.Match) -> str:
    """The drawing of a Mermaid diagram."""
    path = DIAGRAMS / f"{hashlib.sha256(matched[1].encode()).hexdigest()[:16]}.svg"
    if not path.is_file():
        raise PluginError(f"a diagram without a drawing: run `npm run diagrams` in clients/dashboard\n{matched[1]}")
    return f'<div class="diagram">{path.read_text().strip()}</div>'


def _place_of(linked: str, files) -> str | None:
    """The page of a file of the repository; None: it has none."""
    if linked in COPIES:
        return COPIES[linked]
    if linked in ELSEWHERE or linked.startswith("examples/"):
        return ELSEWHERE.get(linked, "examples.md")
    inside = linked.removeprefix("docs/")
    return inside if linked.startswith("docs/") and files.get_file_from_path(inside) else None

"""The documentation site: it builds without a warning, needs no other host, and its search knows every page."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WITHOUT_SITE = {"README.md"}  # of docs: the site's first page
LOADS = {"script": "src", "img": "src", "iframe": "src", "link": "href", "source": "src"}
HARMLESS = ("canonical", "next", "prev", "edit")  # relations of links that load nothing

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("material") is None, reason="needs pip install 'ddakf[docs]'"),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built site."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280, check=False, env=environment)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return folder


class Loaded(HTMLParser):
    """What a page loads from other hosts."""

    def __init__(self, page: Path):
        super().__init__()
        self.foreign: list[str] = []
        self.feed(page.read_text())

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        address = values.get(LOADS.get(tag, ""), "") or ""
        if re.match(r"(https?:)?//", address) and values.get("rel") not in HARMLESS:
            self.foreign.append(address)


def test_no_page_loads_anything_from_another_host(site):
    for page in site.rglob("*.html"):
        assert Loaded(page).foreign == [], page.relative_to(site)
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*['\"]?(https?:)?//", sheet.read_text()), sheet.relative_to(site)


def test_diagrams_are_drawn(site):
    page = (site / "architecture.html").read_text()
    assert re.search(r'<div class="diagram"><svg .*Tracker\.step', page, re.S)
    for document in site.rglob("*.html"):
        assert 'class="mermaid"' not in document.read_text(), document.relative_to(site)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Chromium")
def test_the_search_answers_in_a_page_that_was_opened_from_a_folder(site, tmp_path):
    """A page of its own has the query in its address, as the site's search accepts it."""
    address = f"{(site / 'index.html').as_uri()}?q=relocalization"
    flags = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}", "--virtual-time-budget=20000"]
    ended = subprocess.run(["chromium", *flags, "--dump-dom", address], capture_output=True, text=True, timeout=250, check=False)
    assert "md-search-result__link" in ended.stdout, ended.stderr[-2000:]


def test_every_document_is_a_page_and_is_found_by_the_search(site):
    found = {entry["location"].partition("#")[0] for entry in json.loads((site / "search/search_index.json").read_text())["docs"]}
    for document in (ROOT / "docs").glob("*.md"):
        if document.name not in WITHOUT_SITE:
            assert (site / f"{document.stem}.html").is_file(), document.name
            assert f"{document.stem}.html" in found, document.name


def test_the_reference_has_classes_commands_routes_and_messages(site):
    for page, words in {
        "reference/library.html": ("Tracker", "step", "sensor_origin", "with_fabric"),
        "reference/client.html": ("create_session", "takeover", "tls_credentials"),
        "reference/command_line.html": ("ddakf track", "--live", "ddakf view", "--recording"),
        "reference/rest.html": ("GET /v1/recording", "POST /v1/sessions"),
        "reference/messages.html": ('id="trackingservice"', 'id="createsessionrequest"', "FLOW_MODE_LOSSLESS", "capture_time"),
        "examples.html": ("01_track_a_cloud", "07_browser_client", "09_depth_folder", "10_read_the_reliability"),
        "changes.html": ("Unreleased",),
    }.items():
        text = (site / page).read_text()
        for word in words:
            assert word in text, f"{page}: {word}"
        assert not re.search(r":(meth|class|func):", text), page

"""Dashboard: the page, its assets and the sample, as a browser gets them."""

from __future__ import annotations

import io
import re
from urllib.parse import urljoin

import httpx
import numpy as np
import pytest
from ddakf_service.transports.rest.pages import dashboard

from ddakf import data

from ..conftest import TIMEOUT

MAX_BYTES = 1_500_000  # of the build
TYPES = {"js": "text/javascript", "css": "text/css", "svg": "image/svg+xml", "html": "text/html", "txt": "text/plain"}


@pytest.fixture(scope="module")
def page(service):
    return httpx.get(f"{service.http}/", timeout=TIMEOUT)


def linked(page: httpx.Response) -> list[str]:
    """The addresses of the page's scripts, styles and pictures."""
    return re.findall(r'(?:src|href)="([^"]+)"', page.text)


def test_the_page_runs_its_own_scripts_alone(page):
    assert page.status_code == 200
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    policy = dict(rule.split(" ", 1) for rule in page.headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == policy["worker-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert page.headers["x-content-type-options"] == "nosniff"
    assert not re.search(r"<style|<script(?![^>]*src=)| style=| on[a-z]+=", page.text)


def test_every_address_is_relative_so_that_a_proxy_may_add_a_path(page):
    assert len(linked(page)) >= 3
    for address in linked(page):
        assert urljoin("https://example.org/some/path/", address).startswith("https://example.org/some/path/assets/"), address


def test_assets_are_cached_for_ever_and_the_page_is_asked_for_again(service, page):
    assert page.headers["cache-control"] == "no-cache"
    for address in linked(page):
        asset = httpx.get(urljoin(f"{service.http}/", address), timeout=TIMEOUT)
        assert asset.status_code == 200
        assert asset.headers["content-type"].startswith(TYPES[address.rpartition(".")[2]])
        assert "immutable" in asset.headers["cache-control"]
        assert re.search(r"-[\w-]{8}\.\w+$", address), "its name has a hash of its content"


@pytest.mark.parametrize("path", ["/", "/v1/sample"])
def test_an_unchanged_copy_is_not_sent_again(http, path):
    tag = http.get(path).headers["etag"]
    again = http.get(path, headers={"If-None-Match": f'"other", W/{tag}'})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    assert http.get(path, headers={"If-None-Match": '"other"'}).status_code == 200


def test_a_browser_gets_it_compressed(service, page):
    script = urljoin(f"{service.http}/", next(address for address in linked(page) if address.endswith(".js")))
    plain = httpx.get(script, headers={"Accept-Encoding": "identity"}, timeout=TIMEOUT)
    small = httpx.get(script, headers={"Accept-Encoding": "gzip"}, timeout=TIMEOUT)
    assert "content-encoding" not in plain.headers
    assert (small.headers["content-encoding"], small.headers["vary"]) == ("gzip", "Accept-Encoding")
    assert small.content == plain.content
    assert int(small.headers["content-length"]) < len(plain.content) / 2


@pytest.mark.parametrize("path", ["/assets/nothing.js", "/assets/..%2findex.html", "/assets/%2e%2e/index.html", "/index.html"])
def test_other_files_are_not_served(http, path):
    answer = http.get(path)
    assert (answer.status_code, answer.json()["error"]["name"]) == (404, "NotFound")


def test_the_sample_is_the_bundled_recording(http):
    answer = http.get("/v1/sample")
    assert answer.headers["content-type"] == "application/octet-stream"
    with np.load(io.BytesIO(answer.content)) as archive:
        assert np.array_equal(archive["garment_rest"], data.sample().template)


def test_the_build_is_small_and_names_the_licences_of_its_parts():
    files = dashboard.files()
    assert sum(len(file.content) for file in files.values()) < MAX_BYTES
    licences = files["assets/licenses.txt"].content.decode()
    for package in ("three", "uplot", "fzstd", "@bufbuild/protobuf"):
        assert package in licences, package

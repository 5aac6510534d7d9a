"""Documentation page: complete, from this server alone, without scripts."""

from __future__ import annotations

import base64
import hashlib
import re
from html.parser import HTMLParser

import httpx
import pytest

from .http_alone import http_alone


class Page(HTMLParser):
    """Elements, targets, identifiers and the style of a page."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: set[str] = set()
        self.targets: list[str] = []
        self.ids: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.targets += [value for name, value in attributes if name in ("href", "src", "action")]
        self.ids += [value for name, value in attributes if name == "id"]
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, "elements are nested"


@pytest.fixture(scope="module")
def http():
    with http_alone() as port, httpx.Client(base_url=port.url) as http:
        yield http


@pytest.fixture(scope="module")
def answer(http):
    return http.get("/docs")


def test_nothing_is_loaded_from_elsewhere_and_nothing_runs(answer):
    page = Page(answer.text)
    assert answer.headers["content-type"].startswith("text/html")
    assert page.open == []
    assert page.tags & {"script", "iframe", "img", "link", "object", "form"} == set()
    assert [target for target in page.targets if not target.startswith(("#", "openapi.json"))] == []  # relative
    assert "http://" not in answer.text
    assert "https://" not in answer.text
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert re.search(r"https?:", policy) is None
    (style,) = re.findall("<style>(.*?)</style>", answer.text, re.DOTALL)
    assert base64.b64encode(hashlib.sha256(style.encode()).digest()).decode() in policy


def test_every_link_has_its_target_once(answer):
    page = Page(answer.text)
    assert len(set(page.ids)) == len(page.ids)
    assert {target[1:] for target in page.targets if target.startswith("#")} <= set(page.ids)


def test_the_list_tells_what_each_operation_is_for(http, answer):
    document = http.get("/openapi.json").json()
    purposes = re.findall('<span class="purpose">(.*?)</span>', answer.text)
    assert len(purposes) == sum(len(methods) for methods in document["paths"].values())
    assert [purpose for purpose in purposes if not 10 < len(purpose) < 120] == []
    assert "Ends a session and its stream" in purposes


def test_every_operation_parameter_field_and_status_is_on_the_page(http, answer):
    document = http.get("/openapi.json").json()
    for path, methods in document["paths"].items():
        for operation in methods.values():
            section = answer.text.partition(f'id="{operation["operationId"]}"')[2].partition("<h3")[0]
            names = [*operation["responses"], *(parameter["name"] for parameter in operation.get("parameters", ()))]
            assert [name for name in names if f"<code>{name}</code>" not in section] == [], path
    for name, schema in document["components"]["schemas"].items():
        section = answer.text.partition(f'id="{name}"')[2].partition("<h3")[0]
        assert [field for field in schema.get("properties", ()) if f"<code>{field}</code>" not in section] == [], name


def test_the_pages_of_the_framework_are_gone(http):
    for path in ("/redoc", "/docs/oauth2-redirect"):
        assert http.get(path).status_code == 404

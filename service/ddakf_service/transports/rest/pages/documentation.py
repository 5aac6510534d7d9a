"""Documentation page: the OpenAPI document as one HTML page without scripts or foreign sources."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterable
from html import escape
from typing import Any

STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222;background:#fff}"
    "h2{margin-top:2.5rem;border-bottom:1px solid #ccc}h3{margin:2rem 0 .3rem}code,pre{font:.9em ui-monospace,monospace}"
    "pre{background:#f4f4f4;padding:.6rem;overflow-x:auto}table{border-collapse:collapse;width:100%;margin:.4rem 0}"
    "th,td{text-align:left;vertical-align:top;padding:.15rem .8rem .15rem 0;border-bottom:1px solid #eee}"
    "th{font-weight:600}b.method{display:inline-block;min-width:4.5rem}"
    "ul{list-style:none;padding:0}li{margin:.2rem 0}.purpose{margin-left:1rem;opacity:.75;font-size:.9em}"
    "@media(prefers-color-scheme:dark){body{color:#ddd;background:#1b1b1b}pre{background:#262626}a{color:#8bf}"
    "h2,th,td{border-color:#444}}"
)
_STYLE_HASH = base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()
PATH = "/docs"
POLICY = f"default-src 'none'; frame-ancestors 'none'; style-src 'sha256-{_STYLE_HASH}'; connect-src 'self' ws: wss:"
"""Content-Security-Policy of the page: its own style; calls of this service, which a person types into the browser's console."""

_SCHEMAS = "#/components/schemas/"
_MOST_VALUES = 12  # of an enumeration on the page


def documentation_page(document: dict[str, Any]) -> str:
    """The page of an OpenAPI document: operations by tag, then the schemas that they link."""
    operations = [
        (operation["tags"][0], method.upper(), path, operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]
    tags = dict.fromkeys(tag for tag, *_ in operations)
    title = escape(f"{document['info']['title']} {document['info']['version']}")
    body = [
        f"<h1>{title}</h1>{_paragraphs(document['info']['description'])}",
        '<p>As a document for programs: <a href="openapi.json">openapi.json</a>. A key travels as '
        "<code>Authorization: Bearer KEY</code>.</p>",
        f"<ul>{''.join(_entry(method, path, operation) for _, method, path, operation in operations)}</ul>",
    ]
    for tag in tags:
        body.append(f"<h2>{escape(tag)}</h2>")
        body += [_operation(method, path, operation) for of, method, path, operation in operations if of == tag]
    body.append("<h2>schemas</h2>")
    body += [_schema(name, schema) for name, schema in sorted(document["components"]["schemas"].items())]
    head = f'<meta charset="utf-8"><title>{title}</title><meta name="viewport" content="width=device-width">'
    return f'<!doctype html><html lang="en"><head>{head}<style>{STYLE}</style></head><body>{"".join(body)}</body></html>'


def _entry(method: str, path: str, operation: dict) -> str:
    link = f'<a href="#{operation["operationId"]}"><code>{escape(path)}</code></a>'
    purpose = _first_sentence(operation.get("description", ""))
    return f'<li><b class="method">{method}</b> {link}<span class="purpose">{escape(purpose)}</span></li>'


def _first_sentence(text: str) -> str:
    """Text up to its first end of a sentence, or of a part that stands alone."""
    return re.split(r"[.;:](?:\s|$)", text, maxsplit=1)[0]


def _operation(method: str, path: str, operation: dict) -> str:
    parts = [
        f'<h3 id="{operation["operationId"]}"><b class="method">{method}</b> <code>{escape(path)}</code></h3>',
        _paragraphs(operation.get("description", "")),
    ]
    if parameters := operation.get("parameters"):
        rows = ((p["name"], f"{p['in']}, {_type(p['schema'])}", _meaning(p["schema"], p.get("description"))) for p in parameters)
        parts.append(_table(("parameter", "place, type", "meaning"), rows))
    for kind, content in operation.get("requestBody", {}).get("content", {}).items():
        parts.append(f"<p>Body: <code>{escape(kind)}</code>, {_type(content['schema'])}</p>")
        for name, example in content.get("examples", {}).items():
            parts.append(_call(method, path, name, example["value"]))
    rows = ((status, _result(response), escape(response["description"])) for status, response in operation["responses"].items())
    parts.append(_table(("status", "body", "meaning"), rows))
    return "".join(parts)


def _call(method: str, path: str, name: str, value: Any) -> str:
    """An example of a call for a terminal; the page's own address is not known here."""
    data = json.dumps(value).replace("'", "'\\''")
    return f"<pre># {escape(name)}\ncurl -X {method} $SERVER{escape(path)} -d '{escape(data, quote=False)}'</pre>"


def _schema(name: str, schema: dict) -> str:
    required = schema.get("required", ())
    rows = (
        (field, _type(of) + (", required" if field in required else ""), _meaning(of, of.get("description")))
        for field, of in schema.get("properties", {}).items()
    )
    return f'<h3 id="{escape(name)}">{escape(name)}</h3>{_paragraphs(schema.get("description", ""))}' + _table(
        ("field", "type", "meaning"), rows
    )


def _table(heads: Iterable[str], rows: Iterable[tuple[str, str, str]]) -> str:
    """A table whose first column is text and whose others are HTML."""
    head = "".join(f"<th>{head}</th>" for head in heads)
    lines = (f"<tr><td><code>{escape(first)}</code></td><td>{second}</td><td>{third}</td></tr>" for first, second, third in rows)
    return f"<table><tr>{head}</tr>{''.join(lines)}</table>"


def _result(response: dict) -> str:
    content = response.get("content", {})
    return ", ".join(_type(of["schema"]) if of.get("schema") else escape(kind) for kind, of in content.items())


def _type(schema: dict) -> str:
    """The type of a schema, linked where it has a name."""
    if "$ref" in schema:
        name = escape(schema["$ref"].removeprefix(_SCHEMAS))
        return f'<a href="#{name}">{name}</a>'
    if alternatives := schema.get("anyOf"):
        return " or ".join(map(_type, alternatives))
    if "prefixItems" in schema:
        return f"[{', '.join(map(_type, schema['prefixItems']))}]"
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items', {}))}"
    return escape(schema.get("format") or schema.get("type") or "any")


def _meaning(schema: dict, description: str | None) -> str:
    """The description with the values and the range."""
    values = schema.get("enum") or schema.get("items", {}).get("enum") or []
    ends = [f"{words} {schema[key]:g}" for key, words in _ENDS.items() if key in schema]
    shown = [", ".join(map(str, filter(None, values[:_MOST_VALUES])))] if values else []
    default = [f"default {schema['default']}"] if schema.get("default") not in (None, "", [], {}) else []
    return "; ".join(escape(part) for part in (description, *shown, *ends, *default) if part)


def _paragraphs(text: str) -> str:
    """Markdown's paragraphs and code as HTML."""
    blocks = (re.sub(r"`+([^`]+)`+", r"<code>\1</code>", escape(block)) for block in text.split("\n\n") if block.strip())
    return "".join(f"<p>{block}</p>" for block in blocks)


_ENDS = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}

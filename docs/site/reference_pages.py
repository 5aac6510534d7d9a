"""Generated pages of the documentation site: library, client, command line, REST, messages and examples."""

from __future__ import annotations

import argparse
import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

LIBRARY = {
    "Tracking": ("ddakf.tracker.Tracker", "ddakf.results.FrameResult", "ddakf.results.InputWarning"),
    "Meshes and fabrics": ("ddakf.mesh.Mesh", "ddakf.mesh.vertex_normals", "ddakf.physics.fabric.Fabric"),
    "Configuration": ("ddakf.config.Config",),
    "Files": ("ddakf.files.io", "ddakf.files.sequence", "ddakf.files.depth"),
    "Sensors": ("ddakf.evaluation.sensors.virtual_sensor", "ddakf.evaluation.sensors.camera"),
    "Errors": ("ddakf.errors",),
}
CLIENT = {
    "Client": ("ddakf_client.client", "ddakf_client.aio"),
    "Frames and results": ("ddakf_client.frames", "ddakf_client.results", "ddakf_client.history"),
    "Recordings": ("ddakf_client.recordings.recording",),
    "Encryption": ("ddakf_client.tls",),
    "Codecs": ("ddakf_api.codec",),
    "Errors": ("ddakf_api.errors",),
}


def generated_pages(root: Path) -> dict[str, str]:
    """The text of each page by its place in the site."""
    return {
        "reference/library.md": _docstrings("Library", LIBRARY),
        "reference/client.md": _docstrings("Python client", CLIENT),
        "reference/command_line.md": _command_line(),
        "reference/rest.md": _rest(),
        "reference/messages.md": _messages((root / "protos/ddakf_api/v1/tracking.proto").read_text()),
        "examples.md": _examples(root / "examples"),
    }


def _docstrings(title: str, groups: dict[str, tuple[str, ...]]) -> str:
    parts = [f"# {title}"]
    for heading, names in groups.items():
        parts += [f"## {heading}", *(f"::: {name}\n    options: {{heading_level: 3}}" for name in names)]
    return "\n\n".join(parts)


def _command_line() -> str:
    """The help of every command, in the commands' own words."""
    from ddakf.commands.cli import _parser

    parser = _parser()
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    parts = ["# Command line"]
    for name, command in sorted(commands.choices.items()):
        parts += [f"## ddakf {name}", f"```text\n{command.format_help().rstrip()}\n```"]
    return "\n\n".join(parts)


def _rest() -> str:
    """The operations of the OpenAPI document, by path."""
    from ddakf_service.settings import Settings
    from ddakf_service.transports.rest.openapi import openapi_document
    from ddakf_service.transports.rest.routes import create_app

    nothing = SimpleNamespace(meshes=None)  # the routes are described, none is called
    document = openapi_document(create_app(nothing, Settings(data_dir="none"), nothing, str, nothing))
    source = "Each server has this document as `/openapi.json` and `/docs`. Bodies: [messages](messages.md)."
    parts = ["# REST", source]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            parts += [f"## {method.upper()} {path}", operation.get("description", "").strip()]
            if rows := [
                (f"`{each['name']}`", each["in"], each.get("description", "")) for each in operation.get("parameters", ())
            ]:
                parts.append(_table(("parameter", "in", "meaning"), rows))
            rows = [(status, answer.get("description", "")) for status, answer in operation["responses"].items()]
            parts.append(_table(("status", "answer"), rows))
    return "\n\n".join(part for part in parts if part)


def _messages(proto: str) -> str:
    """Messages, enumerations and methods of the contract with their comments, from the proto file."""
    parts = ["# Messages", "Package `ddakf_api.v1`, from `tracking.proto`."]
    for kind, name, comment, body in _blocks(proto):
        parts += [f"## {name}", f"*{kind}*{'. ' if comment else ''}{comment}"]
        if rows := list(_fields(kind, body)):
            parts.append(_table(("method" if kind == "service" else "field", "type", "meaning"), rows))
    return "\n\n".join(parts)


def _blocks(proto: str) -> Iterator[tuple[str, str, str, str]]:
    """Kind, name, comment and body of the blocks at the left margin."""
    pattern = re.compile(r"((?:^//[^\n]*\n)*)^(?:(message) (\w+) \{\}|(service|message|enum) (\w+) \{\n(.*?)^\})", re.S | re.M)
    for found in pattern.finditer(proto):
        comment, empty, empty_name, kind, name, body = found.groups()
        yield kind or empty, name or empty_name, _words(comment), body or ""


def _fields(kind: str, body: str) -> Iterator[tuple[str, str, str]]:
    comment: list[str] = []
    for line in (line.strip() for line in body.splitlines()):
        if line.startswith("//"):
            comment.append(line)
            continue
        if method := re.match(r"rpc (\w+)\((stream )?(\w+)\) returns \((stream )?(\w+)\)", line):
            name, sent, request, received, answer = method.groups()
            yield f"`{name}`", f"{sent or ''}{request} → {received or ''}{answer}", _words("\n".join(comment))
        elif value := re.match(r"(\w+) = (-?\d+)(?: \[.*\])?;\s*(//.*)?", line) if kind == "enum" else None:
            yield f"`{value[1]}`", value[2], _words("\n".join([*comment, value[3] or ""]))
        elif field := re.match(r"((?:optional |repeated )?[\w.<>, ]+?) (\w+) = \d+(?: \[.*\])?;\s*(//.*)?", line):
            yield f"`{field[2]}`", field[1].replace("<", "&lt;"), _words("\n".join([*comment, field[3] or ""]))
        comment = []


def _words(comment: str) -> str:
    lines = (line.strip().removeprefix("//").strip() for line in comment.splitlines())
    return " ".join(filter(None, lines))


def _examples(folder: Path) -> str:
    """Each numbered example with its own first sentence, whole."""
    parts = ["# Examples", "Each runs as it stands, and in the tests."]
    for path in sorted(folder.glob("[0-9][0-9]_*")):
        if path.is_dir():
            parts += [f"## {path.name}", f"```js\n{(path / 'main.js').read_text().rstrip()}\n```"]
            continue
        if path.suffix == ".ipynb":
            parts += _notebook(path)
            continue
        source = path.read_text()
        words = ast.get_docstring(ast.parse(source)) or ""
        parts += [f"## {path.stem}", words.splitlines()[0], f"```python\n{source.rstrip()}\n```"]
    return "\n\n".join(parts)


def _notebook(path: Path) -> list[str]:
    """The cells of a notebook; its headings are below the example's."""
    parts = [f"## {path.stem}"]
    for cell in json.loads(path.read_text())["cells"]:
        source = "".join(cell["source"])
        is_code = cell["cell_type"] == "code"
        parts.append(f"```python\n{source}\n```" if is_code else re.sub("^#", "###", source, flags=re.M))
    return parts


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    def line(cells) -> str:
        return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"

    return "\n".join([line(heads), line("---" for _ in heads), *map(line, rows)])

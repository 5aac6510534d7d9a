"""The documents say what the files say: the stage table, the tables of numbers, the links, the commands."""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from ddakf import config as configuration
from ddakf import tracker
from ddakf.commands.cli import _parser

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "protos/README.md",
             ROOT / "clients/python/README.md", ROOT / "results/README.md"]  # fmt: skip
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"```(\w*)\n(.*?)```", re.S)


class Row(NamedTuple):
    """A row of the stage table."""

    stage: str
    paper: str
    module: str  # below ddakf, without .py
    kernel: str  # path from the root, or empty
    test: str
    configuration: list[str]
    section: str  # anchor in docs/algorithm.md


def stage_table() -> list[Row]:
    text = (ROOT / "docs/architecture.md").read_text()
    table = text.partition("| stage | paper | module |")[2].partition("\n\n")[0].splitlines()[2:]
    rows = []
    for line in table:
        stage, paper, module, kernel, test, config, section = (cell.strip() for cell in line.strip("|").split("|"))
        target = [link[0].removeprefix("../") if (link := LINK.findall(cell)) else "" for cell in (module, kernel, test)]
        name = target[0].removeprefix("ddakf/").removesuffix(".py")
        anchor = LINK.findall(section)[0].partition("#")[2]
        rows.append(Row(stage, paper, name, target[1], target[2], re.findall(r"`(\w+)`", config), anchor))
    return rows


STAGES = stage_table()


def headings(document: Path) -> set[str]:
    """Anchors of a document, as GitHub makes them."""
    lines = re.sub(r"```.*?```", "", document.read_text(), flags=re.S).splitlines()
    titles = (line.lstrip("#").strip() for line in lines if line.startswith("#"))
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def called_stages() -> list[str]:
    """Names of the modules that ``Tracker.step`` calls, in the order of the first call."""
    tree = ast.parse(Path(tracker.__file__).read_text())
    step = next(node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == "step")
    calls = [node.func for node in ast.walk(step) if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
    names = [(call.lineno, call.value.id) for call in calls if isinstance(call.value, ast.Name)]
    modules = {name for name in dir(tracker) if getattr(getattr(tracker, name), "__spec__", None)}
    return list(dict.fromkeys(name for _, name in sorted(names) if name in modules))


def documented(name: str) -> str:
    """A module's name as the table writes it."""
    return getattr(tracker, name).__name__.removeprefix("ddakf.").replace(".", "/")


def test_every_stage_of_the_tracker_is_in_the_table():
    not_stages = {"time", "np", "frame_input"}  # the clock, arrays, and the check of the input
    missing = {documented(name) for name in called_stages() if name not in not_stages} - {row.module for row in STAGES}
    assert not missing, f"Tracker.step calls {missing}, which docs/architecture.md does not list"


def test_the_tracker_goes_through_the_letters_in_order_with_the_papers_sections():
    source = Path(tracker.__file__).read_text().partition("def step")[2].partition("def snapshot")[0]
    comments = re.findall(r"# ([A-H])\. \w[\w ]*?(?: \(([\d., ]+)\))?(?:,.*)?$", source, re.M)
    assert [letter for letter, _ in comments] == list("ABCDEFGH")
    for letter, sections in comments:
        listed = {section for row in STAGES if row.stage == letter for section in row.paper.split(", ")}
        assert set(filter(None, sections.split(", "))) <= listed


@pytest.mark.parametrize("row", STAGES, ids=lambda row: row.module)
def test_a_row_of_the_stage_table(row):
    assert (ROOT / f"ddakf/{row.module}.py").is_file()
    stem = row.module.rpartition("/")[2]
    if (ROOT / f"ddakf/kernels/{stem}.py").is_file():
        assert row.kernel == f"ddakf/kernels/{stem}.py", "it has a kernel of its own stem"
    assert row.kernel == "" or (ROOT / row.kernel).is_file()
    assert row.test == "" or (ROOT / row.test).is_file()
    own = f"tests/{row.module.rpartition('/')[0]}/test_{stem}.py"
    if (ROOT / own).is_file():
        assert row.test in (own, f"tests/kernels/test_{stem}.py"), "it has a test of its own stem"
    for name in row.configuration:
        assert hasattr(configuration, name), f"{name} is no class of ddakf.config"
    assert row.section in headings(ROOT / "docs/algorithm.md")


@pytest.mark.parametrize("row", STAGES, ids=lambda row: row.module)
def test_a_stage_says_its_letter_and_the_papers_section_in_its_first_line(row):
    first = importlib.import_module("ddakf." + row.module.replace("/", ".")).__doc__.splitlines()[0]
    if letter := re.match(r"Stage ([A-H])", first):
        assert letter[1] == row.stage
    for section in row.paper.split(", ") if re.match(r"Stage|Preprocessing", first) else ():
        assert section in first, f"the table says {section}, the module: {first}"


def test_every_class_of_the_configuration_has_a_stage():
    listed = {name for row in STAGES for name in row.configuration}
    classes = {name for name, value in vars(configuration).items()
               if isinstance(value, type) and issubclass(value, configuration.Checked)}  # fmt: skip
    assert classes - {"Checked"} == listed


def test_the_tables_are_what_the_code_says():
    check = [sys.executable, ROOT / "benchmarks/reference.py", "--check"]
    ended = subprocess.run(check, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_the_quoted_measurements_are_those_of_the_result_file():
    check = [sys.executable, ROOT / "benchmarks/report.py", "--check"]
    ended = subprocess.run(check, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, "run python benchmarks/report.py --write" + ended.stderr
    assert json.loads((ROOT / "benchmarks/results/bench.json").read_text())["size"] != "quick"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_link_is_dead(document):
    for target in LINK.findall(CODE.sub("", document.read_text())):
        if re.match(r"https?:", target):
            continue
        path, _, anchor = target.partition("#")
        linked = (document.parent / path).resolve() if path else document
        assert linked.exists(), f"{document.name}: {target} is not there"
        if anchor:
            assert anchor in headings(linked), f"{document.name}: {target} has no such heading"


def test_the_commands_of_the_documents_exist():
    text = "\n".join(document.read_text() for document in DOCUMENTS)
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
    assert set(re.findall(r"\bmake ([a-z-]+)(?=`|  )", text)) <= targets
    commands = next(a for a in _parser()._actions if a.dest == "command").choices
    for block in (body for language, body in CODE.findall(text) if not language):
        for name, rest in re.findall(r"^ddakf ([a-z]+)(.*)$", block, re.M):
            flags = re.findall(r"--[a-z-]+", rest.partition("  ")[0])
            parser = commands[name]
            actions = next((a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)), {})
            parser = actions.get(rest.split(maxsplit=1)[0] if rest else "", parser)
            assert set(flags) <= set(parser._option_string_actions), f"ddakf {name} {rest}"
    for script in re.findall(r"python ((?:docs|benchmarks|examples|protos)/\w+\.py)", text):
        assert (ROOT / script).is_file()


def test_the_readmes_python_is_right():
    blocks = [body for language, body in CODE.findall((ROOT / "README.md").read_text()) if language == "python"]
    for block in blocks:
        compile(block, "README.md", "exec")
    run = [sys.executable, "-W", "error", "-c", blocks[0]]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=100, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("tracking") == 4


def test_the_first_screen_of_the_readme():
    lines = (ROOT / "README.md").read_text().partition("\n## ")[0].splitlines()
    assert len(lines) < 40
    assert any(line.startswith("![") for line in lines)
    assert (ROOT / "docs/demo.webp").stat().st_size < 1.5e6

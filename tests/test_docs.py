"""The documents say what the files say: the stage table, the tables of numbers, the links, the commands."""

from __future__ import annotations

import argparse
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from ddakf import Config, Tracker, tracker
from ddakf import config as configuration
from ddakf.commands.cli import _parser
from tests.tracker_runs import SAMPLE, SHIRT, WEARER

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md")),
             *sorted((ROOT / "docs/results").glob("*.md")), ROOT / "protos/README.md",
             ROOT / "clients/python/README.md", ROOT / "clients/typescript/README.md", ROOT / "results/README.md"]  # fmt: skip
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"```(\w*)\n(.*?)```", re.S)


class Row(NamedTuple):
    """A module of the stage table."""

    stage: str
    paper: str
    module: str  # below ddakf, without .py
    configuration: list[str]
    section: str  # document in docs and its anchor


def stage_table() -> list[Row]:
    text = (ROOT / "docs/architecture.md").read_text()
    table = text.partition("| stage | paper | module |")[2].partition("\n\n")[0].splitlines()[2:]
    rows = []
    for line in table:
        stage, paper, modules, config = (cell.strip() for cell in line.strip("|").split("|"))
        letter, section = stage[1:].partition("]")[0], LINK.findall(stage)[0]
        names = (link.removeprefix("../ddakf/").removesuffix(".py") for link in LINK.findall(modules))
        rows += [Row(letter, paper, name, re.findall(r"`(\w+)`", config), section) for name in names]
    return rows


STAGES = stage_table()
# Modules without a test file of their own: those of the stages that use them cover them.
SHARED_TESTS = {"garment/clusters", "garment/model", "physics/rest", "results", "types"}


def headings(document: Path) -> set[str]:
    """Anchors of a document, as GitHub makes them."""
    lines = re.sub(r"```.*?```", "", document.read_text(), flags=re.S).splitlines()
    titles = (line.lstrip("#").strip() for line in lines if line.startswith("#"))
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def steps(config: Config) -> None:
    """Four steps of the sample: tracking, a jump, and a search after it."""
    started = Tracker(SHIRT, body=WEARER, config=config)
    for k, shift in enumerate((0.0, 0.0, 0.02, 0.5)):
        points = SAMPLE.garment_vertices[k] + np.float32([shift, 0, 0])
        bodies = SAMPLE.body_vertices[k] if k < 3 else None
        how = {"timestamp": k / 3, "sensor_origin": (0.0, 1.0, 3.0), "body_vertices": bodies}
        started.step(points, budget=10.0 if k == 1 else None, **how)


def visited_modules() -> set[str]:
    """Modules of the core, kernels excepted, that a new tracker and its steps run."""
    found = set()

    def visit(frame, event, _argument):
        name = frame.f_globals.get("__name__", "")
        if event == "call" and name.startswith("ddakf.") and not name.startswith("ddakf.kernels"):
            found.add(name.removeprefix("ddakf.").replace(".", "/"))

    for config in (Config(), Config.paper()):
        steps(config)  # compiles the kernels, which a profile would slow down
        sys.setprofile(visit)
        try:
            steps(config)
        finally:
            sys.setprofile(None)
    return found


def test_the_table_has_the_modules_that_a_step_passes_through_and_no_others():
    visited = {name for name in visited_modules() if (ROOT / f"ddakf/{name}.py").is_file()}  # no packages
    not_stages = {"tracker", "config", "mesh", "errors", "snapshot", "first_frame"}
    stages = {name for name in visited if name.partition("/")[0] not in not_stages}
    missing = stages - {row.module for row in STAGES}
    assert not missing, f"Tracker.step runs {missing}, which docs/architecture.md does not list"
    unused = {row.module for row in STAGES} - stages
    assert not unused, f"docs/architecture.md lists {unused}, which Tracker.step does not run"


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
    folder, _, stem = row.module.rpartition("/")
    tests = ROOT / f"tests/{folder}/test_{stem}.py", ROOT / f"tests/kernels/test_{stem}.py"
    assert row.module in SHARED_TESTS or any(test.is_file() for test in tests), "it has a test of its own stem"
    for name in row.configuration:
        assert hasattr(configuration, name), f"{name} is no class of ddakf.config"
    document, _, anchor = row.section.partition("#")
    assert anchor in headings(ROOT / "docs" / document)


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
    ended = subprocess.run(check, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_the_quoted_measurements_are_those_of_the_result_file():
    check = [sys.executable, ROOT / "benchmarks/report.py", "--check"]
    ended = subprocess.run(check, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == 0, "run python benchmarks/report.py --write" + ended.stderr
    assert json.loads((ROOT / "benchmarks/results/bench.json").read_text())["size"] != "quick"


def test_the_tables_of_the_claimed_errors_are_those_of_the_result_files(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    tables = importlib.import_module("error_tables")
    found, laws = tables.read()
    assert tables.shares(found, laws) in (ROOT / "docs/algorithm.md").read_text(), "python benchmarks/error_tables.py"
    assert tables.worth(found["said"]["held-out"]) in (ROOT / "docs/read_reliability.md").read_text()


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


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_lines_are_broken_at_100_characters(document):
    text = CODE.sub("", document.read_text())
    long = [line for line in text.splitlines() if len(line) > 100 and not re.match(r"#|\s*(\||!?\[)|<!--", line)]
    assert not long, f"{document.name}: {long[0][:80]}"


def test_the_commands_of_the_documents_exist():
    text = "\n".join(document.read_text() for document in DOCUMENTS)
    targets = set(re.findall(r"^([a-z\d-]+):", (ROOT / "Makefile").read_text(), re.M))
    inline = re.findall(r"`make ([a-z\d -]+)`", CODE.sub("", text))
    lines = [line.partition("#")[0] for language, body in CODE.findall(text) if not language for line in body.splitlines()]
    blocks = re.findall(r"(?:^|&& )make ([a-z\d -]+)", "\n".join(lines), re.M)
    called = {target for words in (*inline, *blocks) for target in words.partition("  ")[0].split() if not target.startswith("-")}
    assert len(called) > 10
    assert called <= targets
    commands = next(a for a in _parser()._actions if a.dest == "command").choices
    for block in (body for language, body in CODE.findall(text) if not language):
        for name, rest in re.findall(r"^(?:.*(?: -- | exec \S+ |&& ))?ddakf ([a-z]+)(.*)$", block, re.M):
            flags = re.findall(r"--[a-z-]+", rest.partition("  ")[0])
            parser = commands[name]
            actions = next((a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)), {})
            first = rest.split(maxsplit=1)[0] if rest.strip() else ""
            assert not actions or first in actions or not first.islower(), f"ddakf {name} {first}"
            parser = actions.get(first, parser)
            assert set(flags) <= set(parser._option_string_actions), f"ddakf {name} {rest}"
    for script in re.findall(r"python ((?:docs|benchmarks|examples|protos)/\w+\.py)", text):
        assert (ROOT / script).is_file()


def test_the_readmes_python_is_right():
    blocks = [body for language, body in CODE.findall((ROOT / "README.md").read_text()) if language == "python"]
    for block in blocks:
        compile(block, "README.md", "exec")
    run = [sys.executable, "-W", "error", "-c", blocks[0]]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.count("tracking") == 4


def test_the_first_screen_of_the_readme():
    lines = (ROOT / "README.md").read_text().partition("\n## ")[0].splitlines()
    assert len(lines) < 40
    assert any(line.startswith("![") for line in lines)
    for picture in ("demo", "dashboard"):
        assert (ROOT / f"docs/{picture}.webp").stat().st_size < 1.5e6

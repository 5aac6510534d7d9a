"""Benchmarks of uncommitted code do not write into the checkout's results, where they would be taken for the project's."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from ddakf.evaluation import machine

RESULTS = Path(__file__).parents[1] / "benchmarks/results"
BY_ITSELF = ("bench", "camera_places", "chaos", "cluster", "coarse_templates", "cost", "kill", "latency", "load", "mutants",
             "other_triangles", "parts", "soak", "triangulations", "tuning")  # fmt: skip
WHERE_TOLD = {"accuracy": "--summary", "colour": "--out", "conditions": "--json", "error_size": "--json", "faust": "--json",
              "omission": "--json", "headings": "--json", "predictability": "--json", "recovery": "--json",
              "reliability": "--json"}  # fmt: skip


@pytest.fixture
def dirty(monkeypatch):
    monkeypatch.setattr(machine, "commit", lambda *_: f"0123abc{machine.DIRTY}")


def refused(name, monkeypatch, capsys, *words):
    """Whether the benchmark ends with the sentence before it measures anything."""
    module = importlib.import_module(name)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *words])
    with pytest.raises(SystemExit) as ended:
        module.main()
    return ended.value.code == 2 and "expected committed code, or --allow-dirty" in capsys.readouterr().err


@pytest.mark.parametrize("name", BY_ITSELF)
def test_a_benchmark_that_writes_a_result_wants_committed_code(name, dirty, monkeypatch, capsys):
    assert refused(name, monkeypatch, capsys)


def test_a_plan_of_a_fleet_is_printed_all_the_same_and_its_figures_are_not_measured(dirty, monkeypatch, capsys):
    assert importlib.import_module("scaling").main(["--sessions", "100"]) == 0
    assert refused("scaling", monkeypatch, capsys, "--measure")


@pytest.mark.parametrize(("name", "option"), WHERE_TOLD.items())
def test_a_benchmark_that_is_told_where_to_write_does_too(name, option, dirty, monkeypatch, capsys):
    assert refused(name, monkeypatch, capsys, option, str(RESULTS / f"{name}.json"))


def test_all_benchmarks_that_write_a_result_are_tried():
    texts = {path.stem: path.read_text() for path in RESULTS.parent.glob("*.py")}
    texts.pop("clips")  # the command of two of them
    writing = {name for name, text in texts.items() if "committed import parsed" in text or "clips.main(" in text}
    assert writing == {*BY_ITSELF, *WHERE_TOLD, "scaling"}
    naming = {name for name, text in texts.items() if "machine.commit()" in text}
    assert naming <= writing

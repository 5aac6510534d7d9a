"""Import graph: no circles, a longest chain of imports in the core, the evaluation and the service, no kernels in the network
process."""

import inspect
import subprocess
import sys
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
import pytest

from ddakf import Tracker

LARGEST_FOLDER = 12  # modules
LONGEST = {"core": 10, "evaluation": 10, "service": 10}  # modules
# The commands stand above everything and start it: they are no part of a chain.
AREAS = {
    "core": lambda name: name.startswith("ddakf.") and not name.startswith(("ddakf.evaluation", "ddakf.commands")),
    "evaluation": lambda name: name.startswith("ddakf.evaluation"),
    "service": lambda name: name.startswith("ddakf_service.") and not name.startswith("ddakf_service.commands"),
}


@pytest.fixture(scope="module")
def graph():
    return grimp.build_graph("ddakf", "ddakf_service", "ddakf_api", "ddakf_client", cache_dir=None)


def imports(graph, belongs):
    """By module of an area the modules of that area that it imports, when it is loaded or later."""
    chosen = {name for name in graph.modules if belongs(name)}
    return {name: graph.find_modules_directly_imported_by(name) & chosen for name in chosen}


def longest_chain(imported):
    """The modules of the longest chain of imports; a circle raises ``graphlib.CycleError``, which names its modules."""
    chains = {}
    for name in TopologicalSorter(imported).static_order():
        chains[name] = [name, *max((chains[other] for other in sorted(imported[name])), key=len, default=[])]
    return max(chains.values(), key=len)


@pytest.mark.parametrize("area", AREAS)
def test_no_chain_of_imports_is_too_long(graph, area):
    chain = longest_chain(imports(graph, AREAS[area]))
    assert len(chain) <= LONGEST[area], " -> ".join(chain)


def test_no_circle_of_imports(graph):
    longest_chain(imports(graph, lambda name: True))


def test_no_folder_holds_too_many_modules():
    """Kernels excepted, which share the names of the stages; generated modules and an ``__init__`` do not count."""
    root = Path(__file__).parents[1]
    modules = Counter(
        path.parent.relative_to(root).as_posix()
        for package in ("ddakf", "service/ddakf_service", "protos/ddakf_api", "clients/python/ddakf_client")
        for path in (root / package).rglob("*.py")
        if path.stem != "__init__" and "_pb2" not in path.stem
    )
    modules.pop("ddakf/kernels")
    assert {folder: n for folder, n in modules.items() if n > LARGEST_FOLDER} == {}


def test_the_network_process_imports_no_kernel():
    program = "import sys, ddakf_service.commands.serve; print(*{'numba', 'scipy', 'ddakf.tracker'} & {*sys.modules})"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == ""


def test_a_chain_is_counted_in_modules():
    assert longest_chain({"a": {"b", "c"}, "b": {"c"}, "c": set(), "d": set()}) == ["a", "b", "c"]


def test_a_step_can_be_read_at_a_glance():
    """The orchestrator: a comment and a call for each stage of the paper."""
    assert len(inspect.getsource(Tracker.step).splitlines()) <= 45

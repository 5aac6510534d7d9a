"""Import graph: no circles, and a longest chain of imports in the core, the evaluation and the service."""

from graphlib import TopologicalSorter

import grimp
import pytest

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


def test_a_chain_is_counted_in_modules():
    assert longest_chain({"a": {"b", "c"}, "b": {"c"}, "c": set(), "d": set()}) == ["a", "b", "c"]

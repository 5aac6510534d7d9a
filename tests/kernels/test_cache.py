"""The cache of compiled kernels: an edit compiles what it can change and nothing else; copies share; no disk is no error."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ddakf.kernels import cache

PACKAGE = Path(cache.__file__).parent
SOURCES = {
    "shape": """
class Pair(NamedTuple):
    a: float
    b: float


@njit(cache=True)
def width(x):
    return x + 1.0
""",
    "area": """
from ddakf.kernels.shape import width

@njit(cache=True)
def area(x):
    return width(x)
""",
    "volume": """
from ddakf.kernels.area import area

@njit(cache=True)
def volume(x):
    return area(x)
""",
    "angle": """
@njit(cache=True)
def angle(pair):
    return pair.a - 2.0 * pair.b
""",
}
PROGRAM = """
from ddakf.kernels import angle, area, shape, volume
kernels = {"angle": angle.angle, "area": area.area, "shape": shape.width, "volume": volume.volume}
print(*(kernel(shape.Pair(3.0, 1.0) if name == "angle" else 1.0) for name, kernel in kernels.items()))
print(*(name for name, kernel in kernels.items() if kernel.stats.cache_misses))
"""
VALUES = [1.0, 2.0, 2.0, 2.0]
LIMITED = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))\n"


@pytest.fixture
def clone(tmp_path):
    """Makes a copy of a package of small kernels at a path of its own."""

    def make(name="first"):
        folder = tmp_path / name / "ddakf/kernels"
        folder.mkdir(parents=True)
        (folder.parent / "__init__.py").touch()
        for own in ("__init__.py", "cache.py"):
            shutil.copy(PACKAGE / own, folder)
        for module, text in SOURCES.items():
            (folder / f"{module}.py").write_text("from typing import NamedTuple\nfrom numba import njit\n" + text)
        return folder

    return make


@pytest.fixture
def compiled(tmp_path):
    """Runs the kernels of a copy in a process of its own: what they return, and the modules that were compiled."""

    def run(folder, first="", place=tmp_path / "cache"):
        own = {"PYTHONPATH": str(folder.parents[1]), "TMPDIR": str(tmp_path), "DDAKF_KERNEL_CACHE": str(place)}
        how = dict(env=os.environ | own | {"PYTHONDONTWRITEBYTECODE": "1"}, cwd=tmp_path, capture_output=True, text=True)
        done = subprocess.run([sys.executable, "-c", first + PROGRAM], **how)
        assert done.returncode == 0, done.stderr
        values, names = done.stdout.split("\n")[:2]
        return [float(value) for value in values.split()], set(names.split())

    return run


def edited(folder, module, old, new):
    path = folder / f"{module}.py"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def changed(folder, module, old, new):
    """The modules whose digest an edit changes."""
    before = cache.digests(folder)
    edited(folder, module, old, new)
    after = cache.digests(folder)
    return {name for name in after if after[name] != before[name]} & set(SOURCES)


@pytest.mark.parametrize(
    ("module", "old", "new", "expected"),
    [
        ("volume", "return area(x)", "return 2 * area(x)", {"volume"}),
        ("area", "return width(x)", "return 2 * width(x)", {"area", "volume"}),
        ("shape", "x + 1.0", "x + 2.0", {"shape", "area", "volume"}),
        ("shape", "a: float\n    b: float", "b: float\n    a: float", set(SOURCES)),
    ],
)
def test_an_edit_changes_the_digests_of_a_module_and_of_its_importers(clone, module, old, new, expected):
    assert changed(clone(), module, old, new) == expected


def test_digests_do_not_depend_on_the_path(clone):
    assert cache.digests(clone("first")) == cache.digests(clone("second"))


def test_every_import_and_named_tuple_of_the_kernels_is_found():
    for path in PACKAGE.glob("*.py"):
        text = path.read_text()
        nodes = list(ast.walk(ast.parse(text)))
        imported = {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
        imported |= {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        kernels = {name.rpartition(".")[2] for name in imported if name.startswith("ddakf.kernels.")}
        assert kernels == set(cache.IMPORT.findall(text)), path.name
        outside = {name for name in imported if name.startswith("ddakf") and not name.startswith("ddakf.kernels")}
        assert not outside, f"{path.name} imports {outside}, whose changes the cache does not see"
        classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
        tuples = [node for node in classes if any(ast.unparse(base) == "NamedTuple" for base in node.bases)]
        found = [ast.parse(block).body[0] for block in cache.NAMED_TUPLE.findall(text)]
        assert [ast.dump(node) for node in tuples] == [ast.dump(node) for node in found], path.name


@pytest.mark.slow
def test_an_edit_compiles_only_its_module_and_importers_and_a_second_copy_nothing(clone, compiled):
    first, second = clone("first"), clone("second")
    assert compiled(first) == (VALUES, {"angle", "shape", "area", "volume"})
    assert compiled(second) == (VALUES, set())
    edited(second, "area", "return width(x)", "return 3 * width(x)")
    assert compiled(second) == ([1.0, 6.0, 2.0, 6.0], {"area", "volume"})
    assert compiled(first) == (VALUES, set())
    edited(second, "shape", "a: float\n    b: float", "b: float\n    a: float")
    values, names = compiled(second)
    assert values[0] == 1.0 - 2.0 * 3.0  # the kernel imports neither the tuple nor its module
    assert names == {"angle", "shape", "area", "volume"}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX limits")
def test_a_full_disk_is_no_error(clone, compiled):
    folder = clone()
    for _ in range(2):
        assert compiled(folder, first=LIMITED) == (VALUES, set(SOURCES))


@pytest.mark.slow
def test_a_cache_that_cannot_be_written_to_is_replaced_by_one_in_the_temporary_directory(clone, compiled, tmp_path):
    folder, place = clone(), tmp_path / "taken"
    place.write_text("a file where the folder should be")
    assert compiled(folder, place=place)[1] == set(SOURCES)
    assert compiled(folder, place=place)[1] == set()


@pytest.mark.slow
def test_a_damaged_file_of_the_cache_is_no_error(clone, compiled, tmp_path):
    folder = clone()
    compiled(folder)
    for path in (tmp_path / "cache").rglob("*.nbc"):
        path.write_bytes(path.read_bytes()[:100])
    assert compiled(folder) == (VALUES, set(SOURCES))


@pytest.mark.parametrize(
    ("lacks", "best"),
    [((), "x86-64-v4"), (("avx512f",), "x86-64-v3"), (("avx2", "avx512f"), "x86-64-v2"), (("cx16",), "generic")],
)
def test_a_level_needs_its_features_and_those_of_the_lower_ones(monkeypatch, lacks, best):
    features = {feature: feature not in lacks for level in cache.LEVELS.values() for feature in level}
    monkeypatch.setattr(cache.llvmlite.binding, "get_host_cpu_features", lambda: features)
    names = list(cache.LEVELS)
    assert cache.supported() == names[names.index(best) :]


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        ({}, "compiled/{best} {best}"),
        ({"DDAKF_KERNEL_CACHE": "/mine"}, "/mine None"),
        ({"NUMBA_CPU_NAME": "generic"}, "/home generic"),
    ],
)
def test_the_best_level_that_was_compiled_beforehand_is_taken(tmp_path, own, expected):
    best = cache.supported()[0]
    for name in {best, "generic"}:
        (tmp_path / "compiled" / name).mkdir(parents=True)
    program = "from ddakf.kernels import cache; import os, numba; print(cache.directory().parent, numba.config.CPU_NAME)"
    environment = {name: value for name, value in os.environ.items() if name not in ("DDAKF_KERNEL_CACHE", "NUMBA_CPU_NAME")}
    environment |= {cache.COMPILED: str(tmp_path / "compiled"), "XDG_CACHE_HOME": "/home", **own}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    expected = expected.format(best=best).replace("compiled", str(tmp_path / "compiled")).replace("/home", "/home/ddakf")
    assert done.stdout.strip() == expected

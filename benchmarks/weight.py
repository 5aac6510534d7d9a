"""Size on the disk of each installed dependency: ``python benchmarks/weight.py [--extra service] [--json | --imports]``.

Files as pip installs them, with bytecode; each distribution once. ``docs/dependencies.md`` has the numbers.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
MB = 1e6  # bytes
IMPORTS = """
import importlib, mmap, pathlib, time
def resident():
    return int(pathlib.Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE
for name in ("numpy", "numba"):
    seconds, before = time.process_time(), resident()
    importlib.import_module(name)
    seconds, grown = time.process_time() - seconds, (resident() - before) / 2**20
    print(f"{name}: {seconds:.2f} s of processor time, {grown:.0f} MiB in memory")
"""


def main(argv: list[str] | None = None) -> int:
    """Prints the sizes, the largest first; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--extra", action="append", default=[], metavar="NAME", help="also what this extra needs")
    parser.add_argument("--json", action="store_true", help="as a JSON object")
    parser.add_argument("--imports", action="store_true", help="instead, the cost of importing numpy, and of numba after it")
    arguments = parser.parse_args(argv)
    if arguments.imports:
        print(subprocess.run([sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True).stdout, end="")
        return 0
    sizes = {"ddakf": _own_size()} | {name: size_of(name) for name in closure(arguments.extra)}
    if arguments.json:
        print(json.dumps({name: round(size / MB, 1) for name, size in sizes.items()}))
        return 0
    for name, size in sorted(sizes.items(), key=lambda item: -item[1]):
        print(f"{name:30} {size / MB:8.1f} MB")
    print(f"{'sum':30} {sum(sizes.values()) / MB:8.1f} MB")
    return 0


def closure(extras: list[str]) -> set[str]:
    """The distributions that ddakf needs. One that is not installed is left out and named."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = [*project["dependencies"], *(text for extra in extras for text in project["optional-dependencies"][extra])]
    found: set[str] = set()
    waiting = [(requirement, "") for requirement in map(Requirement, texts)]
    while waiting:
        requirement, extra = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in found or not (requirement.marker is None or requirement.marker.evaluate({"extra": extra})):
            continue
        try:
            needed = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            print(f"{name} is not installed", file=sys.stderr)
            continue
        found.add(name)
        waiting += [(Requirement(text), extra) for text in needed for extra in (*requirement.extras, "")]
    return found


def size_of(name: str) -> int:
    """Bytes of an installed distribution."""
    files = metadata.distribution(name).files or []
    paths = (Path(file.locate()) for file in files)
    return sum(path.stat().st_size for path in paths if path.is_file())


def _own_size() -> int:
    """Bytes of the library's own files, which an editable installation does not list."""
    return sum(path.stat().st_size for path in (ROOT / "ddakf").rglob("*") if path.is_file())


if __name__ == "__main__":
    sys.exit(main())

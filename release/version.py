"""The version, everywhere it is written: ``version.py`` compares, ``version.py 0.2.0`` sets it.

The root's pyproject.toml has it; distributions of one version need one another, and packages of npm and files of
citation cannot read it from there.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FORM = re.compile(r"\d+\.\d+\.\d+((a|b|rc)\d+)?")
PLACES = {
    "pyproject.toml": [r'^version = "(.*)"$', r'"ddakf-api==([^"]*)"', r'"ddakf-client==([^"]*)"'],
    "protos/pyproject.toml": [r'^version = "(.*)"$'],
    "clients/python/pyproject.toml": [r'^version = "(.*)"$', r'"ddakf-api==([^"]*)"'],
    "clients/typescript/package.json": [r'^  "version": "(.*)",$'],
    "clients/typescript/package-lock.json": [r'\A\{\n  "name": "ddakf-client",\n  "version": "(.*)",$',
                                             r'^    "": \{\n      "name": "ddakf-client",\n      "version": "(.*)",$'],
    "docker/Dockerfile": [r"^ARG VERSION=(.*)$"],
    "CITATION.cff": [r"^version: (.*)$"],
    "uv.lock": [r'^name = "ddakf(?:-api|-client)?"\nversion = "(.*)"$'],
}  # fmt: skip


def main(arguments: list[str]) -> int:
    """Sets the version, or compares its places; returns the exit status."""
    if not arguments:
        wrong = differences()
        print("\n".join(wrong) or current())
        return 1 if wrong else 0
    (version,) = arguments
    if not FORM.fullmatch(version):
        print(f"a version such as 0.2.0 or 0.2.0rc1, not {version!r}", file=sys.stderr)
        return 2
    for name, patterns in PLACES.items():
        text = (ROOT / name).read_text()
        for pattern in patterns:
            text = re.sub(pattern, lambda found: found[0].replace(found[1], version), text, flags=re.M)
        (ROOT / name).write_text(text)
    return main([])


def current() -> str:
    """The version of the root's pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def differences() -> list[str]:
    """One sentence for each place with another version, or without one."""
    wrong, version = [], current()
    for name, patterns in PLACES.items():
        for pattern in patterns:
            found = re.findall(pattern, (ROOT / name).read_text(), re.M)
            if set(found) != {version}:
                wrong.append(
                    f"{name} has {', '.join(sorted(set(found))) or 'no version'} instead of {version}: make version V={version}"
                )
    return wrong


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

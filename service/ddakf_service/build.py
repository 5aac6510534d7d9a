"""Build: the commit of this program, from a file written by the build or from the git checkout."""

from __future__ import annotations

import functools
from pathlib import Path

_HERE = Path(__file__).parent
WRITTEN = _HERE / "BUILD"
"""Written by the build (setup.py); absent in a checkout."""
_SHOWN = 12  # characters of a commit


@functools.cache
def build() -> str:
    """The commit, shortened; empty when it is not known."""
    try:
        return WRITTEN.read_text().strip()
    except OSError:
        return commit_of(_HERE.parents[1])[:_SHOWN]


def commit_of(checkout: Path) -> str:
    """The commit of a checkout, read without git; empty for another folder."""
    try:
        git = checkout / ".git"
        if git.is_file():  # a worktree
            git = checkout / git.read_text().removeprefix("gitdir:").strip()
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head
        common = git / (git / "commondir").read_text().strip() if (git / "commondir").is_file() else git
        name = head.removeprefix("ref: ")
        if (common / name).is_file():
            return (common / name).read_text().strip()
        packed = (common / "packed-refs").read_text().splitlines()
        return next((line.split()[0] for line in packed if line.endswith(" " + name)), "")
    except OSError:
        return ""

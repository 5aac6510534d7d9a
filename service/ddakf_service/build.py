"""What this program was made from: the commit that a build wrote down, or the one of the checkout it runs in."""

from __future__ import annotations

import functools
from pathlib import Path

_HERE = Path(__file__).parent
WRITTEN = _HERE / "BUILD"
"""Written by a build (setup.py); not there in a checkout."""
_SHOWN = 12  # characters of a commit


@functools.cache
def build() -> str:
    """Commit, shortened; empty where nobody knows."""
    try:
        return WRITTEN.read_text().strip()
    except OSError:
        return commit_of(_HERE.parents[1])[:_SHOWN]


def commit_of(checkout: Path) -> str:
    """The commit that is checked out in a folder, read without git; empty where it is no checkout."""
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

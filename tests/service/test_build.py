"""Build: the server's commit is the one that git reports."""

import subprocess
from pathlib import Path

import pytest
from ddakf_service.build import commit_of


def git(folder: Path, *arguments: str) -> str:
    command = ["git", "-c", "user.name=n", "-c", "user.email=e@example.org", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True, timeout=250).stdout.strip()


@pytest.fixture
def checkout(tmp_path):
    folder = tmp_path / "checkout"
    folder.mkdir()
    git(folder, "init", "-q", "-b", "trunk")
    git(folder, "commit", "-q", "--allow-empty", "-m", "first")
    return folder


@pytest.mark.parametrize("state", ["branch", "packed", "detached", "worktree"])
def test_the_commit_of_a_checkout(checkout, state):
    where = checkout
    if state == "packed":
        git(checkout, "pack-refs", "--all")
    elif state == "detached":
        git(checkout, "checkout", "-q", "--detach")
    elif state == "worktree":
        where = checkout.parent / "other"
        git(checkout, "worktree", "add", "-q", "-b", "side", str(where))
        git(where, "commit", "-q", "--allow-empty", "-m", "second")
    assert commit_of(where) == git(where, "rev-parse", "HEAD")


def test_what_is_no_checkout_has_no_commit(tmp_path):
    assert commit_of(tmp_path) == ""


def test_both_sides_name_the_build(client, http):
    assert http.get("/v1/info").json()["build"] == client.server.build

"""Command ``ddakf keys``: a mistyped place is refused, and nothing is made of it."""

from __future__ import annotations

import json
import stat

import pytest

from ddakf.commands import cli


@pytest.mark.parametrize(
    "place", ["--data-dir={}/typo", "--database-url=sqlite:///{}/x.db", "--database-url=sqlite:///{}/typo/x.db"]
)
@pytest.mark.parametrize("action", [["list"], ["revoke", "0123456789ab"]])
def test_keys_of_no_database_are_refused(tmp_path, capsys, place, action):
    assert cli.main(["keys", place.format(tmp_path), *action]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(tmp_path) in line
    assert "does not exist" in line
    assert list(tmp_path.iterdir()) == []


def test_a_key_is_not_made_in_a_mistyped_folder_of_a_url(tmp_path, capsys):
    assert cli.main(["keys", f"--database-url=sqlite:///{tmp_path}/typo/x.db", "create", "x", "--scope", "read"]) == 2
    assert "database_url: expected a file in a folder that exists" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_first_key_makes_the_database_and_says_so(tmp_path, capsys):
    data = tmp_path / "data"
    assert cli.main(["keys", "--data-dir", str(data), "create", "x", "--scope", "read"]) == 0
    assert f"{data}/ddakf.sqlite did not exist and is made" in capsys.readouterr().err
    assert stat.S_IMODE((data / "ddakf.sqlite").stat().st_mode) == 0o600
    assert cli.main(["keys", "--data-dir", str(data), "list", "--json"]) == 0
    out, err = capsys.readouterr()
    assert [row["name"] for row in json.loads(out)] == ["x"]
    assert err == ""


def test_a_table_has_whole_ids_whatever_the_terminal(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    keys = ["keys", "--data-dir", str(tmp_path / "data")]
    cli.main([*keys, "create", "a-name-that-is-longer-than-others", "--scope", "read"])
    capsys.readouterr()
    cli.main([*keys, "list", "--json"])
    (key,) = json.loads(capsys.readouterr().out)
    cli.main([*keys, "list"])
    assert {key["id"], key["name"], key["created"]} <= set(capsys.readouterr().out.split())


def test_a_readable_database_is_told(tmp_path, capsys):
    data = tmp_path / "data"
    cli.main(["keys", "--data-dir", str(data), "create", "x", "--scope", "read"])
    (data / "ddakf.sqlite").chmod(0o644)
    capsys.readouterr()
    cli.main(["keys", "--data-dir", str(data), "list"])
    assert f"chmod 600 {data}/ddakf.sqlite" in capsys.readouterr().err


def test_a_key_in_a_file_is_made_once_for_owner_and_group(tmp_path, capsys):
    file, keys = tmp_path / "metrics.key", ["keys", "--data-dir", str(tmp_path / "data")]
    create = [*keys, "create", "prometheus", "--scope", "read", "--file", str(file)]
    assert cli.main(create) == 0
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert file.read_text().strip() not in capsys.readouterr().out
    first = file.read_text()
    assert cli.main(create) == 0
    assert file.read_text() == first
    assert cli.main([*keys, "revoke", first]) == 0
    assert cli.main(create) == 0
    assert file.read_text() != first
    capsys.readouterr()
    cli.main([*keys, "list", "--json"])
    assert [row["revoked"] is None for row in json.loads(capsys.readouterr().out)] == [False, True]


def test_a_key_that_cannot_be_written_is_not_made(tmp_path, capsys):
    keys = ["keys", "--data-dir", str(tmp_path / "data")]
    assert cli.main([*keys, "create", "x", "--scope", "read", "--file", str(tmp_path / "none/x.key")]) == 2
    assert "file: expected a file that can be written" in capsys.readouterr().err
    cli.main([*keys, "list", "--json"])
    assert json.loads(capsys.readouterr().out) == []

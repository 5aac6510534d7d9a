"""Readiness of a server whose storage fails: the reason is for those who may read it."""

from __future__ import annotations

import httpx
import pytest
from ddakf_service.store.store import Store

from ddakf.commands import cli

from ..transports.http_alone import http_alone


@pytest.fixture
def failing(monkeypatch):
    """Makes the database of each server fail when its readiness is asked for, as if the workers were there."""
    monkeypatch.setattr("ddakf_service.server.Server._not_ready", lambda self: "")
    problem = OSError("no route to 10.0.0.7:5432")
    load = Store.problems

    def problems(store: Store) -> dict[str, str]:
        store.database.condition.fails(problem)
        return load(store)

    monkeypatch.setattr(Store, "problems", problems)


def problems(port, **headers: str) -> list[str]:
    answer = httpx.get(port.url + "/readyz", headers=headers)
    assert (answer.status_code, answer.json()["status"]) == (200, "degraded")
    return answer.json()["problems"]


def test_without_a_key_only_the_failing_part_is_named(failing, tmp_path, capsys):
    place, keys = str(tmp_path / "data"), {}
    for scope in ("read", "stream"):
        cli.main(["keys", "--data-dir", place, "create", scope, "--scope", scope])
        keys[scope] = f"Bearer {capsys.readouterr().out.strip()}"
    with http_alone(require_keys=True, data_dir=place) as port:
        for headers in ({}, {"authorization": keys["stream"]}):
            (named,) = problems(port, **headers)
            assert named.startswith("database: ")
            assert "10.0.0.7" not in named
        assert "10.0.0.7" in problems(port, authorization=keys["read"])[0]


def test_where_no_key_is_needed_the_reason_is_told_but_not_through_a_proxy(failing):
    with http_alone() as port:
        assert "10.0.0.7" in problems(port)[0]
        assert "10.0.0.7" not in problems(port, **{"x-forwarded-for": "192.0.2.1"})[0]

"""What is kept goes when nobody uses it; what is in use stays, whoever else drops."""

import os
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from ddakf.files import cache
from ddakf.files.cache import drop_unused, used

DAY = 86400


@pytest.fixture
def entries(tmp_path):
    """Folders and files of 1,000 bytes, by the days since they were used."""
    found = {}
    for days in (0, 2, 10, 29, 31, 400):
        path = tmp_path / f"of-{days}"
        if days % 2:
            path.mkdir()
            (path / "inside").write_bytes(bytes(1000))
        else:
            path.write_bytes(bytes(1000))
        os.utime(path, (time.time() - days * DAY,) * 2)
        found[days] = path
    return found


def left(entries):
    return [days for days, path in entries.items() if path.exists()]


def test_what_was_not_used_for_a_month_goes(entries, tmp_path):
    assert set(drop_unused(tmp_path.glob("of-*"))) == {entries[31], entries[400]}
    assert left(entries) == [0, 2, 10, 29]
    assert len(list(tmp_path.iterdir())) == 4


def test_beyond_the_bound_those_go_that_were_not_used_for_longest(entries, tmp_path):
    drop_unused(tmp_path.glob("of-*"), most=2000)
    assert left(entries) == [0, 2]


def test_what_was_used_today_stays_whatever_the_bound(entries, tmp_path):
    used(entries[400])
    drop_unused(tmp_path.glob("of-*"), most=0)
    assert left(entries) == [0, 400]


def test_several_processes_may_drop_at_once(entries, tmp_path):
    with ThreadPoolExecutor(4) as pool:
        dropped = list(pool.map(lambda _: drop_unused(list(entries.values())), range(8)))
    assert sorted(path for some in dropped for path in some) == sorted([entries[31], entries[400]])
    assert left(entries) == [0, 2, 10, 29]


def test_what_may_not_be_dropped_stays(entries, tmp_path, monkeypatch):
    def refused(self, target):
        raise PermissionError

    monkeypatch.setattr(cache.Path, "rename", refused)
    assert drop_unused(tmp_path.glob("of-*")) == []
    assert left(entries) == list(entries)

"""Clock: it follows another one without jitter."""

from __future__ import annotations

import pytest
from ddakf_service.store import clock


def test_a_clock_that_follows_another_stays_where_it_may_be_right(monkeypatch):
    here = iter([100.0, 100.2, 200.0, 200.2, 300.0, 300.1, 400.0])
    monkeypatch.setattr(clock.time, "time", lambda: next(here))
    follower = clock.Clock()
    follower.follow(lambda: 107.15)  # 6.95 to 7.15 s ahead
    assert follower._ahead == pytest.approx(6.95)
    follower.follow(lambda: 207.0)  # 6.8 to 7.0
    assert follower._ahead == pytest.approx(6.95)
    follower.follow(lambda: 293.0)  # -7.1 to -7
    assert follower.now() == pytest.approx(393.0)

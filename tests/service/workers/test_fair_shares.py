"""Fair shares of a worker's time, and the budgets of frames that follow."""

from __future__ import annotations

import math

import pytest
from ddakf_service.workers.fair_shares import FairShares, divided
from ddakf_service.workers.messages.wire import Spent
from hypothesis import given
from hypothesis import strategies as st

WANTED = st.dictionaries(st.text(max_size=3), st.floats(0.0, 2.0) | st.just(math.inf), min_size=1, max_size=8)


@given(st.floats(0.01, 4.0), WANTED)
def test_a_division_is_fair(total, wanted):
    shares = divided(total, wanted)
    assert sum(shares.values()) == pytest.approx(total)
    in_want = [name for name in wanted if shares[name] < wanted[name] - 1e-9]
    for name in in_want:  # nobody has more than one who wants more
        assert all(shares[name] >= share - 1e-9 for share in shares.values())


@given(WANTED)
def test_what_suffices_is_granted(wanted):
    wanted = {name: min(share, 2.0) for name, share in wanted.items()}
    shares = divided(sum(wanted.values()) + 0.1, wanted)
    assert all(shares[name] >= share for name, share in wanted.items())


class Load:
    """Sessions that send frames in turn, at 30 per second each; frames that need more than their budget are cut to it.

    A lighter tracker takes the share ``lighter`` of the time of a session's own; without it, and for those in ``fixed``, there is
    none. The first frame of a tracker takes ``cold`` times as long, and the next four a sixth of the difference more.
    """

    def __init__(self, seconds: dict[str, float], speed: float = 1.0, lighter: float = 0.0, cold: float = 1.0, fixed=()):
        self.shares, self.seconds, self.speed, self.lighter, self.cold = FairShares(), dict(seconds), speed, lighter, cold
        self.now, self.light, self.changes = 0.0, dict.fromkeys(seconds, False), 0
        self.tracked, self.fixed = dict.fromkeys(seconds, 0), fixed if lighter else tuple(seconds)

    def budgets(self, frames: int = 200, rate: float = 30.0) -> dict[str, float]:
        """The last ones."""
        found = {}
        for _ in range(frames):
            self.now += 1 / 30
            for name, needed in self.seconds.items():
                found[name], lighter = self.shares.grant(name, rate, self.now)
                lighter = lighter and name not in self.fixed
                changed = lighter != self.light[name]
                self.changes += changed
                self.light[name] = lighter
                self.tracked[name] = 1 if changed else self.tracked[name] + 1
                needed *= self.lighter if lighter else 1.0
                first = self.tracked[name] == 1
                needed *= 1.0 + (self.cold - 1.0) * (1.0 if first else 1 / 6 if self.tracked[name] <= 5 else 0.0)
                used = min(needed, found[name] or math.inf)
                trackers = (lighter, name not in self.fixed)
                self.shares.record(name, Spent(used, 0.0, used / self.speed, 1.5 if used < needed else 1.0, *trackers))
        return found


def test_one_session_has_the_worker_for_itself():
    assert 0.02 < Load({"one": 0.01}).budgets()["one"] < 1 / 30


def test_the_largest_pays():
    """With frames, where it has no lighter tracker."""
    load = Load({"small": 0.005, "medium": 0.006, "large": 0.05})
    budgets, rate = load.budgets(), load.shares.affordable_rate("large")
    assert budgets["small"] >= 0.005
    assert budgets["medium"] >= 0.006
    assert load.shares.affordable_rate("small") == load.shares.affordable_rate("medium") == 0.0
    assert budgets["large"] >= 0.05
    assert 0 < rate < 20
    assert 30 * (0.005 + 0.006) + rate * 0.05 < 0.9


def test_no_session_starves():
    load = Load({f"large {k}": 0.05 for k in range(4)})
    budgets = load.budgets()
    assert len({round(budget, 6) for budget in budgets.values()}) == 1
    rates = [load.shares.affordable_rate(name) for name in budgets]
    assert rates == pytest.approx([0.85 / 4 / 0.05] * 4, rel=0.05)


def test_a_crowded_machine_grants_less():
    quiet, crowded = Load({"one": 0.05}), Load({"one": 0.05}, speed=0.5)
    assert quiet.budgets() == pytest.approx(crowded.budgets())
    assert crowded.shares.affordable_rate("one") == pytest.approx(0.5 * quiet.shares.affordable_rate("one"), rel=0.01)


def test_a_session_that_is_gone_has_no_share():
    load = Load({"here": 0.05, "gone": 0.05})
    load.budgets()
    load.shares.grant("here", 30.0, load.now + 5.0)
    assert load.shares.affordable_rate("here") * 0.05 == pytest.approx(0.85, abs=0.01)


def test_a_lossless_session_uses_its_share_and_has_no_budget():
    load = Load({"lossless": 0.02})
    assert load.budgets(rate=0.0)["lossless"] == 0.0
    for _ in range(20):
        load.shares.grant("realtime", 30.0, load.now)
        load.shares.record("realtime", Spent(0.05, 0.0, 0.05))
    assert 0 < load.shares.affordable_rate("realtime") < 10


def test_frames_that_are_refused_use_the_worker_too():
    """The refused ones of one session leave the other a half of the worker."""
    load = Load({"one": 0.05})
    for _ in range(300):
        load.budgets(frames=1)
        load.shares.grant("refused", 30.0, load.now)
        load.shares.record_refused("refused", Spent(0.05, busy=0.05))
    assert load.shares.affordable_rate("one") * 0.05 == pytest.approx(0.85 / 2, abs=0.01)


def test_a_need_that_ends_is_forgotten():
    load = Load({"one": 0.05, "two": 0.05})
    load.budgets()
    load.seconds["one"] = 0.005
    load.budgets()
    assert load.shares.affordable_rate("two") * 0.05 > 0.6
    assert load.shares.affordable_rate("one") == 0.0


def test_no_usual_frame_is_cut_under_any_load():
    """Sessions without a lighter tracker pay with frames alone."""
    load = Load({f"session {k}": 0.03 for k in range(6)})
    assert all(budget >= 0.06 for budget in load.budgets().values())


def test_what_a_frame_takes_is_followed():
    load = Load({"one": 0.05})
    for seconds in (0.02, 0.05):
        load.seconds["one"] = seconds
        load.budgets(frames=2000)
        assert load.shares.affordable_rate("one") == pytest.approx(0.85 / seconds if seconds > 0.03 else 0.0, rel=0.05)


def test_a_search_does_not_count_as_usual():
    """A lost garment is searched in each frame that has the time; the others of a crowded worker have it not."""
    shares = FairShares()
    for k in range(300):
        for name, search in (("lost", 0.05), ("other", 0.0)):
            grant = shares.grant(name, 30.0, k / 30)
            search = search if grant.budget > 0.06 else 0.0
            shares.record(name, Spent(0.012 + search, search, 0.012 + search, 1.0))
    assert shares.grant("lost", 30.0, 10.0).budget < 0.06
    assert shares.affordable_rate("lost") == 0.0


def used(load: Load) -> float:
    """Processor seconds per second that the sessions take as they are tracked now."""
    return sum(30 * seconds * (load.lighter if load.light[name] else 1.0) for name, seconds in load.seconds.items())


def test_where_time_is_short_lighter_trackers_go_on_and_no_frame_is_left_out():
    load = Load({f"session {k}": 0.015 for k in range(3)}, lighter=0.55)
    load.budgets(frames=300)
    assert any(load.light.values())
    assert used(load) < 0.85
    assert all(load.shares.affordable_rate(name) == 0.0 for name in load.seconds)


def test_a_load_that_no_core_carries_changes_several_trackers_at_once():
    load = Load({"small": 0.004, **{f"large {k}": 0.012 for k in range(4)}}, lighter=0.4)
    load.budgets(frames=14)
    assert sum(load.light.values()) >= 3
    assert not load.light["small"]


def test_slow_first_frames_of_a_session_alone_do_not_change_it():
    load = Load({"one": 0.04}, lighter=0.5)
    load.budgets(frames=12)
    load.seconds["one"] = 0.02
    load.budgets(frames=100)
    assert load.changes == 0


def test_of_a_load_a_little_too_large_one_tracker_changes_before_frames_are_late():
    load = Load({"one": 0.0162, "two": 0.0164}, lighter=0.5)
    load.budgets(frames=2)
    assert not any(load.light.values())
    load.budgets(frames=4)
    assert load.light == {"one": False, "two": True}
    load.budgets(frames=100)
    assert load.light == {"one": False, "two": True}


def test_others_change_where_the_dearest_session_is_lossless():
    load = Load({"one": 0.014, "two": 0.013}, lighter=0.4)
    for _ in range(100):
        load.shares.grant("lossless", 0.0, load.now)
        load.shares.record("lossless", Spent(0.015, 0.0, 0.015))
        load.budgets(frames=1)
    assert load.light == {"one": True, "two": True}


def test_the_dearest_session_pays_first():
    load = Load({"small": 0.005, "large": 0.02, "medium": 0.01}, lighter=0.4)
    load.budgets(frames=300)
    assert load.light == {"small": False, "large": True, "medium": False}


def test_a_session_goes_back_when_there_is_room():
    load = Load({"one": 0.02, "two": 0.02}, lighter=0.5)
    load.budgets(frames=300)
    assert any(load.light.values())
    left = next(name for name, light in load.light.items() if light)
    load.seconds = {left: load.seconds[left]}
    load.budgets(frames=600)
    assert not load.light[left]


def test_one_own_tracker_stays_where_there_is_room_for_one():
    """Although both are short of time at first, when every frame takes longer."""
    load = Load({"one": 0.03, "two": 0.03}, lighter=0.5)
    load.budgets(frames=30)
    assert all(load.light.values())
    load.seconds = dict.fromkeys(load.seconds, 0.016)
    load.budgets(frames=1200)
    assert sorted(load.light.values()) == [False, True]


def test_the_first_frames_of_a_tracker_do_not_change_it():
    """They take longer: nothing is in the caches."""
    load = Load({"one": 0.011, "two": 0.011}, lighter=0.5, cold=2.5)
    load.budgets(frames=600)
    assert load.changes == 0


def test_an_own_tracker_comes_back_although_its_first_frames_take_longer():
    load = Load({"one": 0.03, "two": 0.03}, lighter=0.5, cold=2.0)
    load.budgets(frames=60)
    assert all(load.light.values())
    load.seconds = dict.fromkeys(load.seconds, 0.013)
    load.budgets(frames=1800)
    assert sum(load.light.values()) <= 1
    assert load.changes <= 6


@pytest.mark.parametrize("seconds", [0.016, 0.02, 0.03])
def test_trackers_change_seldom(seconds):
    """Under a load too large for the sessions' own trackers, for ten minutes."""
    load = Load({"one": seconds, "two": seconds}, lighter=0.5)
    load.budgets(frames=18_000)
    assert 0 < load.changes < 40


def test_a_session_without_a_lighter_tracker_goes_on_with_its_own():
    load = Load({"one": 0.02, "two": 0.02})
    load.budgets(frames=300)
    assert load.shares.affordable_rate("one") > 0


@pytest.mark.parametrize("fixed", ["dearer", "cheaper"])
def test_another_changes_where_a_session_has_no_lighter_tracker(fixed):
    load = Load({"dearer": 0.0168, "cheaper": 0.0165}, lighter=0.5, fixed=(fixed,))
    load.budgets(frames=100)
    assert load.light == {"dearer": fixed != "dearer", "cheaper": fixed != "cheaper"}
    assert used(load) < 0.85
    assert all(load.shares.affordable_rate(name) == 0.0 for name in load.seconds)


def test_without_budgets_a_session_has_its_own_tracker():
    load = Load({"one": 0.02, "two": 0.02}, lighter=0.5)
    load.budgets(frames=300)
    name = next(name for name, light in load.light.items() if light)
    assert not load.shares.grant(name, 0.0, load.now).lighter


def test_sessions_of_which_first_frames_take_twice_the_worker_change_at_once():
    load = Load(dict.fromkeys("abcd", 0.01), lighter=0.5, cold=2.5)
    load.budgets(frames=3)
    assert any(load.light.values())
    load.budgets(frames=5)
    assert sum(load.light.values()) >= 2


def test_first_frames_of_what_fits_change_no_tracker():
    """Each takes two and a half times as long as a later one; the later ones leave the worker room."""
    load = Load(dict.fromkeys("ab", 0.01), lighter=0.5, cold=2.5)
    load.budgets(frames=60)
    assert load.changes == 0

"""Fair shares: the processor time of a worker, divided among its sessions, and the budgets of frames that follow.

Max-min fairness: a session that needs less than an equal share gets what it needs, and the others divide the rest. None starves.
The most expensive sessions pay: first with resolution, on a lighter tracker with a coarser mesh, then with frames. Only unusual
frames are cut to their budget, because a cut frame loses more than it saves (``benchmarks/omission.py``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from .messages.wire import WHOLE, Grant, Spent

PLANNED_SHARE = 0.85  # part of a worker's processor time for frames; the rest is for its messages and errors of the plans
_HEADROOM = 1.3  # what a session wants, over what its frames took lately
_SMOOTHING = 0.1  # factor of the exponential moving averages
_ABSENT_AFTER = 2.0  # seconds without a frame after which a session has no share
_LONGEST_INTERVAL = 1.0  # seconds between two frames, up to which they tell a rate
_SMALLEST_BUDGET = 2.0  # over what a whole frame takes
_SHORTAGE = 0.9  # share over load below which the share does not suffice
_SHORTAGE_FRAMES = 18  # in a row without a sufficient share, after which the only session of a worker gets its lighter tracker
_CROWDED_FRAMES = 2  # the same for one of several sessions: each frame that is dropped makes the next one dearer
_OVERLOAD = 2.0  # processor seconds per second that are too much even by first frames, although later ones take half
_FIRST_FRAMES = 10  # of a tracker, before the caches are warm
_FRAMES_TO_JUDGE = 3  # of a tracker, before the least of their times counts as its load
_LIGHTER_COST = 0.5  # expected time of a session's lighter tracker, over that of its own
_DECAY = 0.998  # per frame, of what the own tracker took when it was last in use
_CHANGE_INTERVAL = 0.5  # seconds between two changes of trackers in a worker, so that the effect of each one shows
_RETURN_MARGIN = 1.1  # room beside the other sessions, over what the own tracker takes, for a return to it
_RETURN_AFTER = 5.0  # seconds of such room before a return; doubles after each return that did not last
_LASTING_RETURN = 30.0  # seconds on its own tracker after which a return has lasted
_LONGEST_WAIT = 80.0  # seconds, of the room before a return


@dataclass
class _Demand:
    """A session's use of its worker.

    Attributes:
        last: time of its last frame (monotonic clock, seconds).
        rate: frames per second that are due.
        seconds: moving average of the processor seconds of a frame; infinite before the first.
        cost: moving average of the processor seconds of a whole frame, of which nothing is left out, without the prediction: the
            search for a lost garment would crowd out the other sessions. 0 before the first frame, then the least of the first.
        own_cost: cost of its own tracker, while the lighter one is in use. It decays, because it is often of a motion that is
            over, so that the own tracker is tried again in the end.
        tracked: number of frames of the tracker that is in use.
        granted: processor seconds per second; infinite before the first frame with a budget, and in lossless flow.
        wants_lighter: its lighter tracker is to go on.
        uses_lighter: its lighter tracker has tracked its last frame.
        has_lighter: it has such a tracker, as far as is known; otherwise it pays with frames alone.
        short_frames: number of frames in a row for which its share did not suffice.
        roomy_since: since when the worker would have room for its own tracker (monotonic clock, seconds).
        returned: when it went back to its own tracker (monotonic clock, seconds).
        wait: seconds of room before it goes back.
    """

    last: float
    rate: float
    seconds: float = math.inf
    cost: float = 0.0
    own_cost: float = 0.0
    tracked: int = 0
    granted: float = math.inf
    wants_lighter: bool = False
    uses_lighter: bool = False
    has_lighter: bool = True
    short_frames: int = 0
    roomy_since: float = math.inf
    returned: float = -math.inf
    wait: float = _RETURN_AFTER

    @property
    def share(self) -> float:
        """Processor seconds per second that it wants: those of whole frames."""
        return _HEADROOM * self.rate * max(self.seconds, self.cost) if self.cost else math.inf

    @property
    def load(self) -> float:
        """Processor seconds per second of frames of which nothing is left out."""
        return self.rate * self.cost

    @property
    def has_budget(self) -> bool:
        """Its last frames came in realtime flow: in lossless flow it keeps its own tracker."""
        return math.isfinite(self.granted)

    @property
    def is_new(self) -> bool:
        """Its tracker has just begun: what its frames take says little about later ones."""
        return self.tracked < _FIRST_FRAMES

    @property
    def is_short(self) -> bool:
        """Its share does not suffice, by more than chance, for whole frames."""
        return self.granted < _SHORTAGE * self.load

    @property
    def expected_load(self) -> float:
        """Its load after the change of its tracker that is due or has just been made."""
        if self.wants_lighter and not self.uses_lighter:
            return _LIGHTER_COST * self.load
        return min(self.load, _LIGHTER_COST * self.rate * self.own_cost) if self.uses_lighter and self.is_new else self.load

    def change(self, lighter: bool, now: float) -> None:
        """Wants the other tracker from now on."""
        if lighter:
            self.wait = _RETURN_AFTER if now - self.returned > _LASTING_RETURN else min(2.0 * self.wait, _LONGEST_WAIT)
        else:
            self.returned = now
        self.wants_lighter, self.short_frames, self.roomy_since = lighter, 0, math.inf


class FairShares:
    """Divides the time of one worker. A session takes part from its first frame to its last, in realtime flow or not."""

    def __init__(self):
        self._demands: dict[str, _Demand] = {}
        self._used = self._busy = 0.0  # running means of the processor seconds of a frame, and the worker's seconds for it
        self._changed = -math.inf  # when a session changed its tracker (monotonic clock, seconds)

    def grant(self, session_id: str, rate: float, now: float) -> Grant:
        """What the session's next frame may take.

        Args:
            rate: frames per second that arrive in realtime flow; 0: the session has no budget and its own tracker, but uses its
                share.
            now: monotonic clock, seconds.
        """
        demand = self._demands.get(session_id)
        if demand is None:
            crowded = any(other.wants_lighter for other in self._demands.values())
            demand = self._demands[session_id] = _Demand(now, rate, wants_lighter=crowded)
        elif rate > 0:
            demand.rate = rate
        elif (pause := now - demand.last) < _LONGEST_INTERVAL:
            demand.rate += _SMOOTHING * (1.0 / max(pause, 1e-3) - demand.rate)
        demand.last = now
        if rate <= 0:
            demand.wants_lighter, demand.granted = False, math.inf
            return WHOLE
        self._demands = {name: other for name, other in self._demands.items() if now - other.last < _ABSENT_AFTER}
        wanted = {name: other.share for name, other in self._demands.items()}
        demand.granted = divided(self._planned, wanted)[session_id]
        self._choose_tracker(demand, now)
        if not demand.cost:
            return Grant(0.0, demand.wants_lighter)
        return Grant(max(demand.granted / rate, _SMALLEST_BUDGET * demand.cost), demand.wants_lighter)

    def _choose_tracker(self, demand: _Demand, now: float) -> None:
        """Changes the tracker of a session whose share has not sufficed for a while, or for whose own one there is room again.

        Both are decided by what usual frames take: a share is short for a second after each frame that takes long.
        """
        settled = now - self._changed > _CHANGE_INTERVAL
        if not demand.has_lighter:
            return
        if not demand.wants_lighter:
            load = sum(other.expected_load for other in self._demands.values())
            several = len(self._demands) > 1
            overloaded = several and load > _OVERLOAD
            is_known = overloaded or demand.tracked >= _FRAMES_TO_JUDGE
            gives_way = is_known and demand.is_short and self._gives_way(demand, load - self._planned)
            demand.short_frames = demand.short_frames + 1 if gives_way else 0
            crowded = several and demand.short_frames >= (1 if overloaded else _CROWDED_FRAMES)
            if crowded or (demand.short_frames >= _SHORTAGE_FRAMES and settled):
                demand.change(True, now)
                self._changed = now
        elif demand.uses_lighter:
            others = sum(other.rate * other.seconds for other in self._demands.values() if other is not demand)
            roomy = others + _RETURN_MARGIN * demand.own_cost * demand.rate < self._planned
            demand.roomy_since = min(demand.roomy_since, now) if roomy else math.inf
            if settled and now - demand.roomy_since > demand.wait:
                demand.change(False, now)
                self._changed = now

    def _gives_way(self, demand: _Demand, excess: float) -> bool:
        """Time is short, and still is when the sessions that take more have changed to their lighter trackers."""
        others = self._demands.values()
        changeable = (other for other in others if other.has_lighter and not other.wants_lighter and other.has_budget)
        return excess > (1.0 - _LIGHTER_COST) * sum(other.load for other in changeable if other.load > demand.load)

    def affordable_rate(self, session_id: str) -> float:
        """Whole frames per second that the session's share allows; 0: more than arrive."""
        demand = self._demands.get(session_id)
        if demand is None or not demand.is_short:
            return 0.0
        return demand.granted / demand.cost

    @property
    def _planned(self) -> float:
        """Processor seconds per second that frames may take; fewer where processes wait for cores."""
        return PLANNED_SHARE * (min(self._used / self._busy, 1.0) if self._busy > 0 else 1.0)

    def forget(self, session_id: str) -> None:
        """The session has left the worker."""
        self._demands.pop(session_id, None)

    def record_refused(self, session_id: str, spent: Spent) -> None:
        """Records what a frame of the session took that was refused. It says nothing about what its tracker takes."""
        self._record_use(spent)
        demand = self._demands.get(session_id)
        if demand is not None and math.isfinite(demand.seconds):
            demand.seconds += _SMOOTHING * (spent.processor - demand.seconds)

    def record(self, session_id: str, spent: Spent) -> None:
        """Records what a tracked frame of the session took."""
        self._record_use(spent)
        demand = self._demands.get(session_id)
        if demand is None:  # it took longer than an absence
            return
        demand.has_lighter = spent.has_lighter
        demand.wants_lighter = demand.wants_lighter and spent.has_lighter
        if spent.lighter != demand.uses_lighter:
            self._record_change(demand, spent.lighter)
        first = math.isinf(demand.seconds)
        demand.seconds = spent.processor if first else demand.seconds + _SMOOTHING * (spent.processor - demand.seconds)
        usual = spent.processor - spent.prediction
        demand.own_cost = max(_DECAY * demand.own_cost, demand.cost) if demand.uses_lighter else 0.0
        demand.tracked += 1
        if spent.widening > 1.0:  # cut: a whole one takes at least as much
            demand.cost = max(demand.cost, usual) if demand.cost else 0.0
        elif demand.cost == 0.0 or demand.is_new:
            demand.cost = min(demand.cost or math.inf, usual)
        else:
            demand.cost += _SMOOTHING * (usual - demand.cost)

    def _record_use(self, spent: Spent) -> None:
        self._used += _SMOOTHING * (spent.processor - self._used)
        self._busy += _SMOOTHING * (spent.busy - self._busy)

    def _record_change(self, demand: _Demand, lighter: bool) -> None:
        """Another tracker has tracked the last frame: what the one before took says nothing about it."""
        demand.uses_lighter, demand.seconds, demand.tracked = lighter, math.inf, 0
        demand.cost, demand.own_cost = 0.0, demand.cost if lighter else 0.0


def divided(total: float, wanted: Mapping[str, float]) -> dict[str, float]:
    """Max-min fair shares of a total. What nobody wants is divided evenly on top."""
    shares, left = {}, total
    for count, (name, share) in zip(range(len(wanted), 0, -1), sorted(wanted.items(), key=lambda item: item[1]), strict=True):
        shares[name] = min(share, left / count)
        left -= shares[name]
    return {name: share + left / len(wanted) for name, share in shares.items()}

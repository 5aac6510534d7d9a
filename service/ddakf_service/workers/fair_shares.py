"""Fair shares: the processor time of a worker, divided among its sessions, and the budgets of frames that follow.

Max-min fairness: a session that needs less than an equal share gets what it needs, and the others divide the rest. None starves,
and the most expensive ones pay: first with the resolution of their mesh, which a lighter tracker goes on with, then with frames.
Budgets leave work out of none but unusual frames: a cut frame loses more than it saves (``benchmarks/omission.py``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from .messages.wire import WHOLE, Grant, Spent

_PLANNED = 0.85  # of the processor time that a worker gets; the rest is its messages, and the error of the plans
_ROOM = 1.3  # of the time that a session's frames took lately, which it may have
_GAIN = 0.1  # of the running means
_ABSENT_AFTER = 2.0  # seconds without a frame after which a session has no share
_PAUSE = 1.0  # seconds, at most, between two frames that tell a rate
_LEAST = 2.0  # times what a whole frame takes: the smallest budget
_SHORT = 0.9  # of its load: a share that is too small
_SHORT_FRAMES = 18  # in a row for which the share of a session alone does not suffice, before its lighter tracker goes on
_CROWDED_FRAMES = 2  # the same of one of several: each frame that is dropped makes the next one dearer
_HOPELESS = 2.0  # processor seconds per second: even first frames tell that this is too much, though later ones take half
_FIRST_FRAMES = 10  # of a tracker; later ones take less, when all is in the caches
_TELLING = 3  # frames of a tracker, whose least time tells the load
_LIGHTER = 0.5  # of the time of its own tracker, which a session's lighter one is expected to take
_FADES = 0.998  # per frame, what the own tracker took
_SETTLED = 0.5  # seconds between two changes of trackers in a worker, so that each one shows
_ROOMY = 1.1  # of what its own tracker takes has room beside the others' when a session goes back to it
_ROOMY_FOR = 5.0  # seconds of such room before; twice as long after each return that did not last
_LASTED = 30.0  # seconds of a return that has lasted
_LONGEST_WAIT = 80.0  # seconds


@dataclass
class _Demand:
    """A session's use of its worker.

    Attributes:
        last: time of its last frame (monotonic clock, seconds).
        rate: frames per second that are due.
        seconds: running mean of the processor seconds of a frame; infinite before the first.
        whole: running mean of the processor seconds of frames of which nothing was left out, after the prediction; 0 before the
            first, the least of a tracker's first ones. A lost garment is searched in each frame where there is time, which would
            crowd out the other work.
        own_whole: the same of its own tracker, while the lighter one is in use. It fades, since it is often of a motion that is
            over: the own tracker is tried again in the end.
        tracked: number of frames of the tracker that is in use.
        granted: processor seconds per second; infinite before the first frame with a budget, and in lossless flow.
        lighter: its lighter tracker is wanted.
        is_lighter: its lighter tracker has tracked its last frame.
        has_lighter: it has such a tracker, as far as is known; otherwise it pays with frames alone.
        short: number of frames in a row for which its share did not suffice.
        roomy_since: since when the worker would have room for its own tracker (monotonic clock, seconds).
        returned: when it went back to its own tracker (monotonic clock, seconds).
        wait: seconds of room before it goes back.
    """

    last: float
    rate: float
    seconds: float = math.inf
    whole: float = 0.0
    own_whole: float = 0.0
    tracked: int = 0
    granted: float = math.inf
    lighter: bool = False
    is_lighter: bool = False
    has_lighter: bool = True
    short: int = 0
    roomy_since: float = math.inf
    returned: float = -math.inf
    wait: float = _ROOMY_FOR

    @property
    def share(self) -> float:
        """Processor seconds per second that it wants: those of whole frames."""
        return _ROOM * self.rate * max(self.seconds, self.whole) if self.whole else math.inf

    @property
    def load(self) -> float:
        """Processor seconds per second of frames of which nothing is left out."""
        return self.rate * self.whole

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
        return self.granted < _SHORT * self.load

    @property
    def expected(self) -> float:
        """Its load after the change of its tracker that is due or has just been made."""
        if self.lighter and not self.is_lighter:
            return _LIGHTER * self.load
        return min(self.load, _LIGHTER * self.rate * self.own_whole) if self.is_lighter and self.is_new else self.load

    def change(self, lighter: bool, now: float) -> None:
        """Wants the other tracker from now on."""
        if lighter:
            self.wait = _ROOMY_FOR if now - self.returned > _LASTED else min(2.0 * self.wait, _LONGEST_WAIT)
        else:
            self.returned = now
        self.lighter, self.short, self.roomy_since = lighter, 0, math.inf


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
            crowded = any(other.lighter for other in self._demands.values())
            demand = self._demands[session_id] = _Demand(now, rate, lighter=crowded)
        elif rate > 0:
            demand.rate = rate
        elif (pause := now - demand.last) < _PAUSE:
            demand.rate += _GAIN * (1.0 / max(pause, 1e-3) - demand.rate)
        demand.last = now
        if rate <= 0:
            demand.lighter, demand.granted = False, math.inf
            return WHOLE
        self._demands = {name: other for name, other in self._demands.items() if now - other.last < _ABSENT_AFTER}
        wanted = {name: other.share for name, other in self._demands.items()}
        demand.granted = divided(self._planned, wanted)[session_id]
        self._choose_tracker(demand, now)
        if not demand.whole:
            return Grant(0.0, demand.lighter)
        return Grant(max(demand.granted / rate, _LEAST * demand.whole), demand.lighter)

    def _choose_tracker(self, demand: _Demand, now: float) -> None:
        """Changes the tracker of a session whose share has not sufficed for a while, or for whose own one there is room again.

        Both are decided by what usual frames take: a share is short for a second after each frame that takes long.
        """
        settled = now - self._changed > _SETTLED
        if not demand.has_lighter:
            return
        if not demand.lighter:
            load = sum(other.expected for other in self._demands.values())
            several = len(self._demands) > 1
            hopeless = several and load > _HOPELESS
            told = hopeless or demand.tracked >= _TELLING
            gives_way = told and demand.is_short and self._gives_way(demand, load - self._planned)
            demand.short = demand.short + 1 if gives_way else 0
            crowded = several and demand.short >= (1 if hopeless else _CROWDED_FRAMES)
            if crowded or (demand.short >= _SHORT_FRAMES and settled):
                demand.change(True, now)
                self._changed = now
        elif demand.is_lighter:
            others = sum(other.rate * other.seconds for other in self._demands.values() if other is not demand)
            roomy = others + _ROOMY * demand.own_whole * demand.rate < self._planned
            demand.roomy_since = min(demand.roomy_since, now) if roomy else math.inf
            if settled and now - demand.roomy_since > demand.wait:
                demand.change(False, now)
                self._changed = now

    def _gives_way(self, demand: _Demand, excess: float) -> bool:
        """Time is short, and still is when the sessions that take more have changed to their lighter trackers."""
        own = (other.load for other in self._demands.values() if other.has_lighter and not other.lighter and other.has_budget)
        return excess > (1.0 - _LIGHTER) * sum(load for load in own if load > demand.load)

    def affordable_rate(self, session_id: str) -> float:
        """Whole frames per second that the session's share allows; 0: more than arrive."""
        demand = self._demands.get(session_id)
        if demand is None or not demand.is_short:
            return 0.0
        return demand.granted / demand.whole

    @property
    def _planned(self) -> float:
        """Processor seconds per second that frames may take; fewer where processes wait for cores."""
        return _PLANNED * (min(self._used / self._busy, 1.0) if self._busy > 0 else 1.0)

    def forget(self, session_id: str) -> None:
        """The session has left the worker."""
        self._demands.pop(session_id, None)

    def record_refused(self, session_id: str, spent: Spent) -> None:
        """Records what a frame of the session took that was refused. It says nothing about what its tracker takes."""
        self._record_use(spent)
        demand = self._demands.get(session_id)
        if demand is not None and math.isfinite(demand.seconds):
            demand.seconds += _GAIN * (spent.processor - demand.seconds)

    def record(self, session_id: str, spent: Spent) -> None:
        """Records what a tracked frame of the session took."""
        self._record_use(spent)
        demand = self._demands.get(session_id)
        if demand is None:  # it took longer than an absence
            return
        demand.has_lighter = spent.has_lighter
        demand.lighter = demand.lighter and spent.has_lighter
        if spent.lighter != demand.is_lighter:
            self._record_change(demand, spent.lighter)
        first = math.isinf(demand.seconds)
        demand.seconds = spent.processor if first else demand.seconds + _GAIN * (spent.processor - demand.seconds)
        usual = spent.processor - spent.prediction
        demand.own_whole = max(_FADES * demand.own_whole, demand.whole) if demand.is_lighter else 0.0
        demand.tracked += 1
        if spent.widening > 1.0:  # cut: a whole one takes at least as much
            demand.whole = max(demand.whole, usual) if demand.whole else 0.0
        elif demand.whole == 0.0 or demand.is_new:
            demand.whole = min(demand.whole or math.inf, usual)
        else:
            demand.whole += _GAIN * (usual - demand.whole)

    def _record_use(self, spent: Spent) -> None:
        self._used += _GAIN * (spent.processor - self._used)
        self._busy += _GAIN * (spent.busy - self._busy)

    def _record_change(self, demand: _Demand, lighter: bool) -> None:
        """Another tracker has tracked the last frame: what the one before took says nothing about it."""
        demand.is_lighter, demand.seconds, demand.tracked = lighter, math.inf, 0
        demand.whole, demand.own_whole = 0.0, demand.whole if lighter else 0.0


def divided(total: float, wanted: Mapping[str, float]) -> dict[str, float]:
    """Max-min fair shares of a total. What nobody wants is divided evenly on top."""
    shares, left = {}, total
    for count, (name, share) in zip(range(len(wanted), 0, -1), sorted(wanted.items(), key=lambda item: item[1]), strict=True):
        shares[name] = min(share, left / count)
        left -= shares[name]
    return {name: share + left / len(wanted) for name, share in shares.items()}

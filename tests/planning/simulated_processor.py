"""A processor whose time is counted, not measured: the plans of a test are the same on every machine."""

from __future__ import annotations

import pytest

from ddakf.planning import clock
from ddakf.search import relocalize
from ddakf.stages import fuse, preprocess, uncertainty

POINT, ROW, PASS, SEARCH, REGISTRATION, END = 2e-7, 5e-7, 2e-4, 0.025, 0.0075, 1e-3  # seconds


class SimulatedProcessor:
    """Advances with the points that are preprocessed, with the vertices that a pass moves, with searches and registrations.

    Attributes:
        now: processor seconds so far.
        slowness: factor on the seconds of all work.
    """

    def __init__(self, patch: pytest.MonkeyPatch, slowness: float = 1.0):
        self.now, self.slowness = 0.0, slowness
        patch.setattr(clock.time, "thread_time", lambda: self.now)
        self._charge(patch, preprocess, "cloud", lambda frame, *_: POINT * (len(frame.points) + 3000))
        self._charge(patch, fuse, "fuse", lambda problem, *_: PASS + ROW * len(problem.prior.position))
        self._charge(patch, relocalize, "_best_fit", lambda *_: SEARCH)
        self._charge(patch, relocalize, "register", lambda *_: REGISTRATION)
        self._charge(patch, uncertainty, "marginals", lambda *_: END)

    def _charge(self, patch: pytest.MonkeyPatch, module, name: str, seconds) -> None:
        function = getattr(module, name)

        def charged(*arguments):
            self.now += self.slowness * seconds(*arguments)
            return function(*arguments)

        patch.setattr(module, name, charged)

"""A crowded worker: shares, budgets, lighter trackers and dropped frames together, with real trackers on a processor that is
counted instead of measured."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from ddakf_service.workers.compute.session_tracker import SessionTracker
from ddakf_service.workers.fair_shares import FairShares
from ddakf_service.workers.messages.wire import Spent

from ddakf import Tracker
from ddakf.evaluation.sensors import Sensor
from tests.lanes import every
from tests.planning.simulated_processor import SimulatedProcessor
from tests.stages.scenes import FPS, rms
from tests.tracker_runs import SAMPLE, SHIRT

SECONDS = 3.0


class Worker:
    """One worker, to whose sessions clouds of the sample come at 30 frames per second each, evenly spread in time. The newest one
    of a session waits, and of sessions with one that with the oldest answer is next.

    Attributes:
        errors: RMS in metres, by session and frame.
    """

    def __init__(self, processor: SimulatedProcessor, sessions: int):
        self._processor, self._shares, self._sensor = processor, FairShares(), Sensor("full", points=4000)
        own = Tracker(SHIRT)
        trackers = [own, *(own.another(own.config) for _ in range(sessions - 1))]
        with ThreadPoolExecutor(1) as builder:
            self._sessions = [SessionTracker(tracker, builder) for tracker in trackers]
            for tracker, session in zip(trackers, self._sessions, strict=True):
                tracker.reset(vertices=SAMPLE.garment_vertices[0])
                session.prepare()
        self.errors = [[] for _ in trackers]

    def run(self) -> None:
        """Tracks for ``SECONDS``."""
        now, count = 0.0, len(self._sessions)
        answered = [0] * count  # frame of the last answer
        while now < SECONDS:
            newest = [int((now - k / count / FPS) * FPS) for k in range(count)]
            waiting = [k for k in range(count) if newest[k] > answered[k]]
            if not waiting:
                now += 0.001
                continue
            k = min(waiting, key=lambda k: answered[k])
            answered[k] = newest[k]
            now += self._track(k, newest[k], now)

    def _track(self, k: int, frame: int, now: float) -> float:
        """The seconds that it takes."""
        grant = self._shares.grant(str(k), FPS, now)
        cloud = self._sensor.capture(SAMPLE, frame, np.random.default_rng([k, frame]))
        session, begun = self._sessions[k], self._processor.now
        result = session.of_frame(grant.lighter).step(cloud.points, timestamp=frame / FPS, budget=grant.budget or None)
        seconds, trackers = self._processor.now - begun, (session.is_lighter, session.has_lighter)
        self._shares.record(str(k), Spent(seconds, result.usage.prediction, seconds, result.usage.widening, *trackers))
        self.errors[k].append(rms(result.vertices - SAMPLE.garment_vertices[frame]))
        return seconds


def errors_of(sessions: int, slowness: float) -> list[list[float]]:
    with pytest.MonkeyPatch.context() as patch:
        worker = Worker(SimulatedProcessor(patch, slowness), sessions)
        worker.run()
    return worker.errors


@pytest.fixture(scope="module")
def alone() -> float:
    """Error of a session that has the worker for itself."""
    (errors,) = errors_of(1, 1.8)
    assert len(errors) > 0.95 * SECONDS * FPS
    return float(np.mean(errors))


@pytest.mark.parametrize(("sessions", "slowness", "frames"), every(3, [(4, 1.8, 28.0), (4, 3.2, 14.0), (6, 1.8, 18.0)]))
def test_a_crowded_worker_tracks_every_session(alone, sessions, slowness, frames):
    """Frames that are dropped make the next ones dearer, so that a load a little too large may end with hardly any answered."""
    errors = errors_of(sessions, slowness)
    counts = [len(each) for each in errors]
    assert min(counts) > 0.9 * frames * SECONDS
    assert max(counts) - min(counts) <= 3
    assert max(np.mean(each) for each in errors) < 1.6 * alone

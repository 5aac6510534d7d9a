"""Budget of a frame: what is planned, learned, left out and told."""

import numpy as np
import pytest

from ddakf import Config, Tracker
from ddakf.errors import InvalidArgument
from ddakf.planning import costs, plan
from ddakf.planning.work import Effort
from ddakf.search import relocalize
from tests.planning import simulated_processor
from tests.planning.simulated_processor import SEARCH, SimulatedProcessor
from tests.stages.scenes import FPS, scan, tube
from tests.tracker_runs import EYE, SAMPLE, SHIRT, assert_same

FRAMES = 24
GARMENT = tube(around=48, along=26, spacing=0.0175)


def shaken(k, count=6000):
    """A cloud of the tube that is shaken: no frame is calm."""
    return scan(GARMENT.vertices, GARMENT, count, 0.002, seed=k) + np.float32([0.02 * np.sin(1.9 * k), 0.0, 0.0])


def run(budget, frames=FRAMES, tracker=None, first=0):
    """A tracker that never searches, and its results."""
    tracker = tracker or Tracker(GARMENT, config=Config.from_dict({"start": {"search": False}}))
    found = [
        tracker.step(shaken(k), timestamp=k / FPS, sensor_origin=EYE, budget=budget) for k in range(first, first + frames)
    ]
    return tracker, found


@pytest.fixture
def processor(monkeypatch):
    return SimulatedProcessor(monkeypatch)


def test_a_budget_that_suffices_changes_nothing():
    (hurried, planned), (unhurried, free) = run(60.0, 6), run(None, 6)
    for ours, theirs in zip(planned, free, strict=True):
        assert_same(ours, theirs)
        assert (ours.usage.budget, ours.usage.widening, theirs.usage.budget) == (60.0, 1.0, None)
        assert ours.usage.seconds > 0
    assert (unhurried._track.costs, hurried._track.costs is None) == (None, False)


@pytest.mark.parametrize("budget", [0.0050, 0.0045, 0.0035])
def test_frames_end_within_their_budget(processor, budget):
    whole = np.median([result.usage.seconds for result in run(None)[1]])
    used = np.array([result.usage.seconds for result in run(budget)[1]])
    assert whole > budget, "the budget is tight"
    assert (used <= 1.2 * budget).mean() >= 0.95
    assert np.median(used) > 0.7 * budget, "what is granted is used"


def test_the_less_is_granted_the_less_is_done(processor):
    found = [run(budget)[1] for budget in (None, 0.0050, 0.0045, 0.001)]
    used = [sum(result.usage.seconds for result in results) for results in found]
    widened = [np.mean([result.usage.widening for result in results]) for results in found]
    assert used == sorted(used, reverse=True)
    assert widened[0] == 1.0 < min(widened[1:])


def test_a_budget_that_nothing_fits_into_still_gives_a_result(processor):
    _, results = run(1e-6, 4)
    assert all(result.observed.mean() > 0.4 for result in results)


def test_a_slower_processor_with_larger_budgets_gives_the_same_results(processor):
    """Results depend on the time that work takes over the budget alone; a plan is no property of the machine."""
    fast, _ = run(0.005)
    slow = Tracker.restore(fast.snapshot())
    track = slow._track.costs
    processor.slowness = 4.0
    rates = {name: rate._replace(mean=4 * rate.mean, deviation=4 * rate.deviation) for name, rate in _rates(track).items()}
    slow._track = slow._track._replace(costs=track._replace(**rates))
    theirs = run(0.02, 6, slow, FRAMES)[1]
    processor.slowness = 1.0
    for ours, other in zip(run(0.005, 6, fast, FRAMES)[1], theirs, strict=True):
        assert_same(ours, other)
        assert ours.usage.widening == other.usage.widening


def _rates(track):
    return {name: getattr(track, name) for name in track._fields[:-1]}


def test_a_restored_tracker_goes_on_with_what_was_learned(processor):
    tracker, _ = run(0.005, 8)
    twin = Tracker.restore(tracker.snapshot())
    for ours, theirs in zip(run(0.005, 6, tracker, 8)[1], run(0.005, 6, twin, 8)[1], strict=True):
        assert_same(ours, theirs)
        assert ours.usage.widening == theirs.usage.widening


def test_without_a_budget_the_speed_of_the_machine_does_not_show(processor):
    quick = run(None, 4)[0]
    processor.slowness = 50.0
    slow = run(None, 4)[0]
    assert slow.snapshot() == quick.snapshot()


@pytest.mark.parametrize(
    ("decision", "effort"),
    [
        ("limit_points", Effort(points=0.25)),
        ("limit_alignment", Effort(passes=0)),
        ("limit_passes", Effort(passes=1)),
    ],
)
def test_what_is_left_out_widens_sigma_and_lowers_the_reliability(monkeypatch, decision, effort):
    """Of a frame of the same estimate: the growths alone differ."""
    monkeypatch.setattr(plan, "limit_points", lambda clock, problem: problem._replace(effort=Effort(planned=True)))
    monkeypatch.setattr(plan, decision, lambda clock, problem: problem._replace(effort=effort._replace(planned=True)))
    results = []
    for growth in (0.0, 0.4):
        names = ("points", "clusters", "passes")
        omission = {f"{name}_growth": growth for name in names}
        tracker = Tracker(SHIRT, config=Config.from_dict({"omission": omission, "start": {"search": False}}))
        tracker.reset(vertices=SAMPLE.garment_vertices[24])
        results.append(tracker.step(SAMPLE.garment_vertices[28], timestamp=0.07))
    whole, widened = results
    np.testing.assert_array_equal(whole.vertices, widened.vertices)
    assert (whole.usage.widening, widened.usage.widening > 1.2) == (1.0, True)
    np.testing.assert_allclose(widened.sigma, widened.usage.widening * whole.sigma, rtol=1e-9)
    assert widened.reliability < whole.reliability


def test_a_search_that_does_not_fit_is_made_now_and_then(processor):
    """A lost garment: its search exceeds every budget, and is made as often as one frame in a hundred allows."""
    tracker, far = Tracker(GARMENT), np.float32([0.0, 0.0, 0.8])
    tracker.step(shaken(0), timestamp=0.0, sensor_origin=EYE, budget=0.006)
    over = []
    for k in range(1, 140):
        result = tracker.step(shaken(k, 800) + k * far, timestamp=k / FPS, sensor_origin=EYE, budget=0.006)
        over.append(result.usage.seconds > SEARCH)
    assert 1 <= sum(over) <= costs.OVERRUNS + 140 * costs.OVERRUN_SHARE
    assert tracker._track.health.state in ("recovering", "lost")


def test_a_search_that_fits_alone_overruns_no_more_often(processor, monkeypatch):
    """It takes less than the budget, and with the rest of its frame a third more."""
    monkeypatch.setattr(simulated_processor, "END", 0.02)
    tracker, budget, over = Tracker(GARMENT), 0.072, []
    for k in range(240):
        cloud = shaken(k, 800) + k * np.float32([0.0, 0.0, 0.8])
        result = tracker.step(cloud, timestamp=k / FPS, sensor_origin=EYE, budget=budget)
        over.append(result.usage.seconds > 1.2 * budget)
    assert sum(over) <= costs.OVERRUNS + 240 * costs.OVERRUN_SHARE + 1, "the first search is known too late"


def test_a_search_is_postponed_not_forgotten(processor):
    tracker = Tracker(GARMENT)
    tracker.step(shaken(0), timestamp=0.0, sensor_origin=EYE, budget=0.006)
    tracker._track = tracker._track._replace(costs=tracker._track.costs._replace(overruns=0.0))
    for k in range(1, 4):  # a jump by half a metre after a pause
        result = tracker.step(shaken(k) + np.float32([0.5, 0.0, 0.0]), timestamp=5 + k / FPS, sensor_origin=EYE, budget=0.006)
        assert result.usage.seconds < SEARCH
    assert tracker._track.health.postponed
    found = tracker.step(shaken(4) + np.float32([0.5, 0.0, 0.0]), timestamp=5 + 4 / FPS, sensor_origin=EYE)
    assert not tracker._track.health.postponed
    assert np.abs(found.vertices.mean(axis=0) - GARMENT.vertices.mean(axis=0))[0] > 0.4


@pytest.mark.parametrize(("budget", "made"), [(None, 1), (1.0, 1), (0.1, 0)])
def test_a_prediction_is_registered_where_a_search_would_fit(processor, monkeypatch, budget, made):
    """What it takes is not learned as the time of a search, which takes longer."""
    calls, register = [], relocalize.register

    def charged(*given):
        calls.append(1)
        processor.now += 2.0 * SEARCH
        return register(*given)

    monkeypatch.setattr(relocalize, "register", charged)
    tracker = Tracker(GARMENT)
    for k, shift in enumerate([0.0, 0.0, 0.1]):
        calls.clear()
        before = tracker._track.costs
        points = scan(GARMENT.vertices, GARMENT, 1500, 0.002, seed=k) + np.float32([shift, 0.0, 0.0])
        tracker.step(points, timestamp=0.1 * k, sensor_origin=EYE, budget=budget)
    assert len(calls) == made
    assert budget is None or tracker._track.costs.search == before.search


@pytest.mark.parametrize("budget", [0.0, -1.0, float("nan"), float("inf"), 10**400, "fast"])
def test_a_budget_is_a_positive_number(budget):
    tracker = Tracker(GARMENT)
    before = tracker.snapshot()
    with pytest.raises(InvalidArgument, match="budget: expected processor seconds above 0"):
        tracker.step(shaken(0), timestamp=0.0, budget=budget)
    assert tracker.snapshot() == before

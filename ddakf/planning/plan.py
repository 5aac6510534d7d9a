"""Plan of a frame with a budget: the work that each stage may take, decided as the stage begins.

Every decision knows the processor time that is left and reserves what the rest of the frame needs at least, by costs that were
learned in earlier frames. What costs most error is left out last: first the second pass at full size, then cluster alignment,
then points (``benchmarks/omission.py``). No stage is broken off. Without a budget nothing is decided.
"""

from __future__ import annotations

from ddakf.planning.clock import Clock
from ddakf.planning.costs import OVERRUN_SHARE, OVERRUNS, SAME_KIND, SPARE_POINTS, bound, learn, typical
from ddakf.planning.work import Costs, Effort
from ddakf.search import relocalize
from ddakf.types import Estimate, Problem, Track


def allow_search(clock: Clock, problem: Problem) -> Problem:
    """The problem, a search allowed or not. One that does not fit is allowed all the same in one of a hundred frames.

    A prediction that misses the cloud is registered where a search would fit, though that takes less: registered in every
    frame of a crowded worker, it would cost more frames than it saves.
    """
    due = relocalize.due(problem)
    if clock.budget is None or not (due or relocalize.far_ahead(problem)):
        return problem
    costs = _costs(problem)
    least = (len(problem.frame.points) + SPARE_POINTS) * bound(costs.points) + _least(problem, costs)
    fits = clock.left() > bound(costs.search) + least
    return problem._replace(effort=Effort(search=fits or (due and costs.overruns >= 1.0), due=due))


def limit_points(clock: Clock, problem: Problem) -> Problem:
    """The problem with the share of the points that preprocessing may use."""
    if clock.budget is None:
        return problem
    costs, count, rule = _costs(problem), len(problem.frame.points), problem.config.omission
    left = clock.left() - _least(problem, costs)
    least = min(1.0, rule.sparsest * len(problem.prior.position) / max(count, 1))
    share = min(1.0, max(least, (left / bound(costs.points) - SPARE_POINTS) / max(count, 1)))
    return problem._replace(effort=Effort(planned=True, due=problem.effort.due, points=share))


def limit_alignment(clock: Clock, problem: Problem) -> Problem:
    """The problem with the passes of cluster alignment."""
    if clock.budget is None:
        return problem
    costs = _costs(problem)
    left = clock.left() - _least(problem, costs)
    return _with_passes(problem, max(left, 0.0) // bound(costs.clusters))


def limit_passes(clock: Clock, problem: Problem) -> Problem:
    """The problem with the passes at full size; the first is always made."""
    if clock.budget is None:
        return problem
    costs = _costs(problem)
    left = clock.left() - bound(costs.first) - bound(costs.end)
    return _with_passes(problem, 1 + max(left, 0.0) // bound(costs.later))


def learn_costs(clock: Clock, track: Track, problem: Problem, estimate: Estimate) -> Track:
    """The track after a frame, with the costs that the clock measured.

    Args:
        clock: of the frame.
        track: with the costs before.
        problem: of the frame, after preprocessing.
        estimate: finished.
    """
    if clock.budget is None:
        return track
    costs, aligned = _costs(problem), estimate.work.clusters
    measured = {"points": clock.spent("preprocess")[0] / (len(problem.frame.points) + SPARE_POINTS)}
    coarse = clock.spent("coarse")[0]
    if aligned:
        measured["clusters"] = max(coarse - costs.probe.mean, 0.0) / aligned
    else:
        measured["probe"] = coarse
    each = clock.spent("associate", "robust", "adapt", "physics", "fuse")
    measured["first"] = each[0]
    if len(each) > 1:
        measured["later"] = sum(each[1:]) / (len(each) - 1)
    measured["end"] = clock.spent("uncertainty", "reliability", "output")[0]
    overruns, searched = costs.overruns + OVERRUN_SHARE, clock.spent("predict")[0]
    if problem.effort.due and searched > SAME_KIND * costs.search.mean:
        measured["search"] = searched
        overruns -= clock.left() < 0.0
    new = learn(costs, measured, problem.model)
    return track._replace(costs=new._replace(overruns=max(0.0, min(overruns, OVERRUNS))))


def _costs(problem: Problem) -> Costs:
    return problem.last.costs or typical(problem.model)


def _least(problem: Problem, costs: Costs) -> float:
    """Seconds that a frame takes at least, after preprocessing."""
    return bound(costs.probe) + bound(costs.first) + bound(costs.end)


def _with_passes(problem: Problem, passes: float) -> Problem:
    return problem._replace(effort=problem.effort._replace(passes=passes))

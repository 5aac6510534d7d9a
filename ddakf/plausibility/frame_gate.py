"""Gate of whole frames: a cloud with which a good fit collapses is of something else, and the prediction is kept."""

from __future__ import annotations

from ddakf.body import contact
from ddakf.config import PaperReliability
from ddakf.planning import omission
from ddakf.stages.reliability import Verdict
from ddakf.types import Estimate, Problem


def collapsed(problem: Problem, estimate: Estimate, verdict: Verdict) -> bool:
    """Whether the reliability has fallen since the last frame as it does with no motion of a garment.

    A single frame of nonsense, of another camera or damaged on its way, lies in part within the gates of single vertices and
    tears the garment, which takes a second to come back. The second such frame in a row is believed, as the reliability before it
    was low. What the work that was left out of the frame takes off its reliability says nothing about the cloud.

    Args:
        problem: the frame.
        estimate: finished.
        verdict: on it.
    """
    config, before = problem.config.reliability, problem.health.reliability
    if isinstance(config, PaperReliability) or estimate.rejected or before < config.gate_above:
        return False
    if len(problem.frame.points) == 0:
        return False  # an empty cloud counts towards a loss, a held frame does not
    share, widening = verdict.health.reliability, omission.widening(problem, estimate)
    whole = share / (share + (1.0 - share) / widening**2)  # score without the widening of the error by omitted work
    return whole < config.gate_ratio * before


def keep_prediction(problem: Problem, estimate: Estimate, verdict: Verdict) -> tuple[Estimate, Verdict]:
    """The estimate put back to the prediction, and the verdict with the evidence about the error as it was before the frame."""
    after, position = verdict.health, problem.prior.position
    health = problem.health._replace(state=after.state, spacing=after.spacing, reliability=after.reliability)
    contacts = None if estimate.contacts is None else contact.nearest_from_last(problem, position)
    terms = estimate.terms._replace(measurement=estimate.terms.measurement._replace(hem=None))
    kept = estimate._replace(position=position, contacts=contacts, terms=terms, rejected=True)
    return kept, verdict._replace(health=health)

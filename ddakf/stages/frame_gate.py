"""Gate of whole frames: a cloud with which a good fit collapses is of something else, and the prediction is kept."""

from __future__ import annotations

from ddakf.config import PaperReliability
from ddakf.stages import uncertainty
from ddakf.stages.reliability import Verdict
from ddakf.types import Estimate, Posterior, Problem


def gate(
    problem: Problem, estimate: Estimate, posterior: Posterior, verdict: Verdict
) -> tuple[Estimate, Posterior, Verdict]:
    """A frame's outcome; that of the prediction where the reliability has collapsed since the last frame.

    A single frame of nonsense (another camera's, or one damaged on its way) lies within the gates of single vertices and tears
    the garment, which takes a second to come back. The motion of a garment, however fast, costs less reliability in one frame. A
    second such frame in a row is believed, as the reliability before it was low.

    Args:
        problem: the frame.
        estimate: finished.
        posterior: of the estimate.
        verdict: on both.
    """
    config, before = problem.config.reliability, problem.health
    if isinstance(config, PaperReliability) or estimate.rejected or before.reliability < config.gate_above:
        return estimate, posterior, verdict
    if verdict.reliability >= config.gate_ratio * before.reliability:
        return estimate, posterior, verdict
    held, after = estimate._replace(position=problem.prior.position, rejected=True), verdict.health
    # what the cloud said of the fit is forgotten with the fit
    health = before._replace(state=after.state, spacing=after.spacing, reliability=after.reliability)
    return held, uncertainty.posterior(problem, held), verdict._replace(health=health)

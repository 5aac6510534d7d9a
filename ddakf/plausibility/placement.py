"""Placement of cloud, sensor and body: points out of reach, of a whole person or behind their sensor, a body apart or off."""

from __future__ import annotations

import numpy as np

from ddakf.body import contact
from ddakf.kernels.preprocess import bounds
from ddakf.plausibility import sidedness
from ddakf.stages.grid import nearest_vertices, spread_rows
from ddakf.types import Estimate, Problem, Sign

SAMPLE = 128  # number of points that are looked at
BEHIND = 0.05  # share of a sensor's points on its other side, from which on they are a sign
ALL_SIDES = 0.75  # share of points behind others, over that of a garment seen from all sides: one camera never sees it
BESIDE = 0.25  # m: points so near to the garment may be of its wearer
BEYOND = 0.1  # share of these points beyond a boundary of the garment, from which on they are a sign
ENOUGH = 20  # least number of these points
SPLIT = 8  # open edges at the place of another, from which on they are a sign; a few may be a slit that is closed at rest
OFF = 0.005  # m, depth of cloth inside the body, from which on it is a sign; exact bodies show 3 mm with 10 mm of noise
SEEN = 0.2  # least share of observed vertices at which the garment's place is known


def nothing_in_reach(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of points none of which is near the garment."""
    points = problem.frame.points
    if len(points) == 0 or not problem.cloud.empty or len(problem.garment.points) == 0:
        return None
    lower, upper = np.empty(3), np.empty(3)
    bounds(estimate.position, 0.0, lower, upper)
    outside = np.maximum(np.maximum(lower - points, points - upper), 0.0)
    nearest = float(np.sqrt(np.square(outside).sum(axis=1).min()))
    return Sign("points", f"none of {len(points)} points is near the garment: the nearest is {nearest:.3g} m from its box")


def whole_person(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a cloud of more than the garment that goes on beyond its boundaries, where the tracker knows of no body."""
    model, rule = problem.model, problem.config.evidence
    explained = problem.last.body is not None or problem.health.least_unexplained <= rule.foreign_share
    if explained or len(model.boundary) == 0 or estimate.observed.mean() < SEEN:
        return None
    points = problem.garment.points[spread_rows(len(problem.garment.points), SAMPLE)]
    nearest, away = nearest_vertices(points, estimate.position, BESIDE)
    outside = away > rule.explained_within(model.edge_length)
    beside = np.count_nonzero(nearest >= 0)
    beyond = np.count_nonzero((nearest >= 0) & outside & np.isin(nearest, model.boundary[:, 0]))
    if beside < ENOUGH or beyond < BEYOND * beside:
        return None
    share = beyond / beside
    missing = "colours or the body" if problem.frame.colors is None else "the body, for colours do not tell them apart"
    sentence = f"{share:.0%} of the points near the garment lie beyond its boundaries, as a wearer's do"
    return Sign("points", f"{sentence}: mask these, or give {missing}")


def points_behind_sensor(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of points near the garment on opposite sides of their sensor, or on sides of it that one sensor cannot see."""
    cloud, origin = problem.cloud, problem.frame.sensor_origin
    if origin is None or cloud.empty:
        return None
    every = -(-cloud.points.shape[1] // SAMPLE)
    if origin.ndim == 1:
        sensor = np.zeros(-(-cloud.points.shape[1] // every), int)
    else:
        sensor = (origin[cloud.index[::every], None] == cloud.sensor).all(axis=2).argmax(axis=1)
    toward = cloud.points[:, ::every].T + (cloud.origin - cloud.sensor)[sensor]
    toward /= np.sqrt(np.einsum("na,na->n", toward, toward) + 1e-18)[:, None]
    mean = np.eye(len(cloud.sensor))[:, sensor] @ toward
    behind = float((np.einsum("na,na->n", toward, mean[sensor]) < 0.0).mean())
    if behind >= BEHIND:
        return Sign("sensor_origin", f"{behind:.0%} of the points lie behind their sensor as it looks at the others")
    if origin.ndim > 1 or problem.last.view.one_sided:  # each point has its origin, or the origin is estimated
        return None
    return _of_several_sensors(problem)


def _of_several_sensors(problem: Problem) -> Sign | None:
    """The sign of points with one origin, from which a sensor sees no more than some of them."""
    sides, hidden = problem.reference.sides, sidedness.hidden_from(problem.frame.sensor_origin, problem)
    if sides.sheet or hidden < ALL_SIDES * sides.hidden_share:
        return None
    what = f"{hidden:.0%} of the points lie behind others as their sensor sees them"
    return Sign("sensor_origin", f"{what}: points of several sensors need an origin each")


def narrow_mask(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a cloud that ends before the garment does wherever the camera looks along it."""
    hem = estimate.terms.measurement.hem
    if hem is None or hem.belief > 0.0:
        return None
    gap = f"the gap beside its rim is {hem.rim_gap:.1f} times that of its other vertices"
    return Sign("points", f"the cloud ends before the garment does, as behind a mask that is too narrow: {gap}")


def split_seams(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a garment that falls apart: along the seams of its texture, or where a part is not joined to the rest."""
    split, gap = problem.reference.split_edges, problem.reference.seam_gap
    if split >= SPLIT:
        return Sign("garment", f"{split} open edges lie at the place of another: Mesh.cleaned() or clean=true joins them")
    if gap > 0.0:
        apart = f"an opening of one part runs {1000 * gap:.0f} mm beside another part"
        return Sign("garment", f"{apart}: join them if they are sewn, as parts move on their own")
    return None


def body_apart(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a body that no part of a garment in view is near."""
    if problem.frame.body_vertices is None or estimate.contacts is None or estimate.observed.mean() < SEEN:
        return None
    if (estimate.contacts.closest.face >= 0).any():
        return None
    middle = estimate.position.mean(axis=0) - problem.frame.body_vertices.mean(axis=0)
    reach, apart = 100 * problem.body.model.reach, float(np.linalg.norm(middle))
    sentence = f"no vertex of the garment is within {reach:.0f} cm of the body: their middles are {apart:.2g} m apart"
    return Sign("body_vertices", sentence)


def body_off(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a body that cloth is seen inside, here and there and not always at the same depth."""
    if problem.frame.body_vertices is None or problem.body is None:
        return None
    off = float(np.sqrt(contact.error2(problem.body)))
    if off < OFF:
        return None
    sentence = f"cloth is seen {1e3 * off:.0f} mm inside the body, which is late or misplaced, if the cloud is not that noisy"
    return Sign("body_vertices", sentence)

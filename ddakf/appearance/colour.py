"""Stage B, colour: what the cloud's colours say along the surface, where planes say nothing (Park, Zhou and Koltun 2017).

Each vertex learns the colours of a patch of cloth around it. A frame's colours are registered with them in the tangent plane,
which measures how far the vertex has slid. What is compared are chromaticities, logarithms of red and of blue over green, which
shading and exposure hardly change. Intensity is left out: folds shade cloth without texture in patterns that do not stick to it.
"""

from __future__ import annotations

from math import log

import numpy as np

from ddakf.config import Colour
from ddakf.kernels import colour as kernels
from ddakf.kernels.associate import FAR_AWAY
from ddakf.kernels.colour import CHANNELS, LOGARITHM, SIDE, ColouredPoints, Patches, SlideLimits, Slides, TangentPlanes
from ddakf.kernels.normals import vertex_normals
from ddakf.physics import rigidity
from ddakf.types import Appearance, Cloud, Estimate, Measurement, Model, Posterior, Problem, Setup, Slide

GATE = -2.0 * log(0.001)  # chi-square of two chromaticities at 99.9 %, beyond which a point does not count
KNOWN = 1e-6  # m^2, least variance at which a patch is learned
BEST = 0.1  # quantile of the variances of the patches, which the whole garment shares
SIDEWAYS = 1.5  # by which a start is farther off along the surface than across it
LEAST_NOISE2 = 1e-5  # of a chromaticity's variance: the noise of one grey level in a bright colour
STILL = 0.1  # texels: a vertex that moved less keeps its registration



def start(model: Model, config: Colour) -> Appearance:
    """Nothing learned."""
    axis, n = _axes(model)[0], len(model.mesh.vertices)
    mean, weight = np.zeros((n, SIDE, SIDE, CHANNELS), np.float32), np.zeros((n, SIDE, SIDE), np.float32)
    return Appearance(axis, mean, weight, np.full(n, np.inf), np.full(CHANNELS, config.noise**2))


def _axes(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) each, the axes of the patches at rest: unit vectors in the tangent plane, the second across the first."""
    normal = np.empty_like(model.mesh.vertices)
    vertex_normals(model.mesh.vertices, model.faces, normal)
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    axis = least - np.einsum("va,va->v", least, normal)[:, None] * normal
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-12)[:, None]
    return axis, np.cross(normal, axis)


def resampled(appearance: Appearance, owner: np.ndarray, source: Setup, target: Setup) -> Appearance:
    """The appearance on another mesh of the same garment.

    Args:
        appearance: on the mesh of ``source``.
        owner: (V',) the vertex of that mesh, out of whose patch each vertex of the other one's comes.
        source, target: the garment on either mesh.
    """
    fresh, grid = start(target.model, target.config.colour), np.arange(SIDE) - 0.5 * (SIDE - 1)
    texel, (first, second) = target.config.colour.texel * grid, _axes(target.model)
    away = target.model.mesh.vertices - source.model.mesh.vertices[owner]
    place = away[:, None, None] + texel[:, None, None] * first[:, None, None] + texel[:, None] * second[:, None, None]
    rows, corner, share = owner[:, None, None], [], []
    for axis in _axes(source.model):
        along = np.einsum("vija,va->vij", place, axis[owner]) / source.config.colour.texel + 0.5 * (SIDE - 1)
        corner.append(np.clip(along, 0, SIDE - 2).astype(np.int64))
        share.append(along - corner[-1])
    inside = np.logical_and(*(((part >= 0.0) & (part <= 1.0)) for part in share))
    mean, weight = np.zeros(fresh.mean.shape), np.zeros(fresh.weight.shape)
    for a, b in np.ndindex(2, 2):
        part = (share[0] if a else 1.0 - share[0]) * (share[1] if b else 1.0 - share[1])
        at = rows, corner[0] + a, corner[1] + b
        mean += part[..., None] * appearance.mean[at]
        inside &= appearance.weight[at] > 0.0
        weight += part * appearance.weight[at]
    return fresh._replace(
        mean=np.where(inside[..., None], mean, 0.0).astype(np.float32),
        weight=np.where(inside, weight, 0.0).astype(np.float32),
        registered2=appearance.registered2[owner],
        noise2=appearance.noise2,
    )


def begin(problem: Problem) -> Problem:
    """The problem with the chromaticities of its cloud."""
    colors, cloud = problem.garment.colors, problem.cloud
    if colors is None or cloud.empty:
        return problem
    channels = np.empty((CHANNELS, len(cloud.index)), np.float32)
    kernels.log_chromaticities(colors, cloud.index, LOGARITHM, channels)
    return problem._replace(cloud=cloud._replace(channels=channels))


def register(problem: Problem, estimate: Estimate, measurement: Measurement) -> Measurement:
    """The measurement with the slides that the colours show.

    Args:
        problem: the frame, with its channels.
        estimate: where the vertices are.
        measurement: their planes.
    """
    appearance, cloud, config = problem.last.appearance, problem.cloud, problem.config.colour
    if appearance is None or not problem.coloured or measurement.normal is None:
        return measurement
    limits = SlideLimits(
        appearance.noise2,
        config.reach,
        GATE,
        config.depth,
        config.least_gradient,
        STILL * config.texel,
    )
    slides = _before(estimate)
    patches, counted = Patches(appearance.mean, appearance.weight, config.texel), 1.0 / appearance.registered2
    kernels.register(_points(cloud), _planes(problem, estimate, measurement, appearance), patches, counted, limits, slides)
    # a point lies on the patches of several vertices
    on_patch = ((SIDE - 1) * config.texel) ** 2 * len(estimate.position) / problem.model.area
    shared = max(1.0, config.shared * on_patch)
    information = 1.0 / (shared * (slides.variance + config.fused_sd**2 + _later(appearance)))
    return measurement._replace(slide=Slide(slides, information))


def _before(estimate: Estimate) -> Slides:
    """A copy of the slides of the pass before; of the first pass, none."""
    slide, n = estimate.terms.measurement.slide, len(estimate.position)
    if slide is None:
        return Slides(np.zeros((2, n, 3)), np.full((2, n), np.inf), np.zeros((n, 3)), np.full((n, 3), FAR_AWAY))
    return Slides(*(array.copy() for array in slide.registered))


def _later(appearance: Appearance) -> np.ndarray:
    """(V,) m^2 by which the place of a patch was less certain than that of the others when it was learned.

    All patches share the error of the garment's place at that time, which no colour corrects.
    """
    registered2 = appearance.registered2
    known = np.isfinite(registered2)
    return np.where(known, np.maximum(registered2 - np.quantile(registered2[known], BEST), 0.0), 0.0) if known.any() else known


def lower_covariance(problem: Problem, estimate: Estimate, covariance: np.ndarray) -> np.ndarray | None:
    """Lowers the (V, 3, 3) covariance by what the colours showed, in place.

    Returns:
        (V,) m^2, variance in the tangent plane before; None where the frame has no colours.
    """
    measurement = estimate.terms.measurement
    if not problem.coloured or measurement.normal is None:
        return None
    normal = measurement.normal
    along = np.einsum("va,vab,vb->v", normal, covariance, normal)
    before = 0.5 * (np.einsum("vaa->v", covariance) - along)
    if measurement.slide is not None and not estimate.rejected:
        slides, config = measurement.slide.registered, problem.config.colour
        claimed = slides.variance + config.claimed_sd**2 + problem.last.appearance.registered2
        kernels.condition(slides.direction, np.where(estimate.observed, 1.0 / claimed, 0.0), covariance)
    return before


def learn(problem: Problem, estimate: Estimate, posterior: Posterior, reliability: float) -> Appearance | None:
    """The appearance after a frame. The more certain the place of a vertex, the more its colours count.

    The fit of the first frame moves vertices along the surface, where no colour holds them yet: what draws them is an error of
    the model. So colours are learned at the start, where the cloud agrees with it.
    """
    appearance, config = problem.last.appearance, problem.config.colour
    if posterior.tangential2 is None or reliability < config.learned_above:
        return appearance
    if appearance is None:
        appearance = start(problem.model, config)
    used, place, variance = estimate.learnable, estimate.position, np.maximum(posterior.tangential2, KNOWN)
    if problem.last.time is None:
        start2 = _start_variance(problem, estimate)
        surer = start2 < np.minimum(variance, config.start_sd**2)
        place, variance = np.where(surer[:, None], problem.prior.position, place), np.where(surer, start2, variance)
    registered2 = np.where(used, np.minimum(appearance.registered2, variance), appearance.registered2)
    most = np.where(np.isfinite(registered2), config.memory / registered2, 0.0)
    mean, weight, squares = appearance.mean.copy(), appearance.weight.copy(), np.empty(CHANNELS + 1)
    planes = _planes(problem, estimate, estimate.terms.measurement, appearance)._replace(position=place, used=used)
    patches = Patches(mean, weight, config.texel)
    kernels.learn(_points(problem.cloud), planes, patches, 1.0 / variance, most, config.depth, squares)
    noise2 = appearance.noise2
    if squares[CHANNELS] > 0:
        share = config.noise_memory
        noise2 = np.maximum(share * noise2 + (1.0 - share) * squares[:CHANNELS] / squares[CHANNELS], LEAST_NOISE2)
    return appearance._replace(mean=mean, weight=weight, registered2=registered2, noise2=noise2)


def _start_variance(problem: Problem, estimate: Estimate) -> float:
    """Variance of the start along the surface, m^2, by how far the first frame has moved it across."""
    moved = estimate.position - problem.prior.position
    across = np.einsum("va,va->v", estimate.terms.measurement.normal, moved)[estimate.learnable]
    return max(KNOWN, SIDEWAYS**2 * float(np.square(across).mean())) if len(across) else np.inf


def _points(cloud: Cloud) -> ColouredPoints:
    return ColouredPoints(cloud.points, cloud.channels, *cloud.grid)


def _planes(problem: Problem, estimate: Estimate, measurement: Measurement, appearance: Appearance) -> TangentPlanes:
    """The patches of the vertices at the estimate, in the planes that were measured."""
    axis = np.einsum("vab,vb->va", rigidity.against_template(estimate.rest, problem.resting), appearance.axis)
    return TangentPlanes(estimate.position, axis, measurement.target, measurement.normal, measurement.found)

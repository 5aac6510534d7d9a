"""Size of the error of every vertex along its normal and across it, by laws of evidence (with stage F's covariance).

The covariance analysis of :mod:`ddakf.stages.uncertainty` knows how the update spreads errors. How large they are in all it does
not know: what it claims was wrong by a factor of two to twenty on garments that slide along themselves, where the cloud lies on
the surface all the same. What gives such an error away is known of every frame: hems that do not meet the end of the cloud,
vertices without a partner, cloth that is loose, far from the body or strained, a shape that slips unnoticed. Each law is fitted
to the errors of many garments, ``benchmarks/error_size.py``.
"""

from __future__ import annotations

from math import log, sqrt
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from ddakf.body import body_anchor
from ddakf.garment.slippage import least_normal_share, some_faces
from ddakf.kernels import error_size as kernels
from ddakf.kernels.error_size import LogLaw
from ddakf.kernels.uncertainty import PatchMeans
from ddakf.types import Estimate, Model, Problem

LEAST_SHARE = 0.02  # least slippage (normal share) that counts: that of the straightest skirts of the fit
BALL = 5.0  # inverse of the slippage of a shape that does not slip
USUAL = 0.005  # m, claimed error at which a law gives its base
FARTHEST = 0.1  # m, longest distance from the body that counts
FARTHEST_ALONG = 0.6  # m, longest distance along the cloth that counts


class PatchStatistics(NamedTuple):
    """Statistics of a frame over each patch, which tell of its error. L patches."""

    size: np.ndarray  # (L,) number of vertices
    observed: np.ndarray  # (L,) number of measured vertices
    means: PatchMeans
    strain: np.ndarray  # (V,) mean squared strain of the edges at each vertex against rest
    isotropic: bool  # whether the measurements are points, as well known across the normal as along it
    missed: np.ndarray  # (3, 3) m^2, mean d d' of what the prediction missed at measured vertices, the body's part included


class SizeEvidence(NamedTuple):
    """Evidence about the size of the error: of each of L patches, of each of V vertices, or one number for all."""

    unmatched: float  # share of the vertices that a sensor may see and that no measurement was found for
    hem: float  # m^2, mean squared distance of hems from where the cloud ends
    clearance: np.ndarray | float  # (V,) m from the body; 0 without one
    slack: np.ndarray | float  # (L,) m, standard deviation of the place on the body; 0 without one
    strain: np.ndarray  # (V,) mean squared strain of the edges at the vertex
    slip: float  # inverse of the least share of a rigid motion that is along the normals, beyond BALL
    offset: float  # m, RMS distance of the cloud from the surface beyond noise, over the last half second
    distance: np.ndarray | float  # (V,) m along the cloth to the nearest measured vertex; 0 beside a body
    free: np.ndarray | float  # (V,) m^2, beside a body the same distance times the clearance; 0 without one
    turned: np.ndarray  # (L,) mean squared sine of the angle between the surface and its planes
    moved: np.ndarray  # (L,) m, RMS motion in this frame, the garment's common one taken out
    soft: float  # squared strain to which the stiffness has adapted
    blind: float  # share of the vertices that were not measured; 0 beside a body


OF_PATCHES = frozenset({"slack", "turned", "moved"})
_SCALES, _POWERS = (attrgetter(*(f"{name}_{kind}" for name in SizeEvidence._fields)) for kind in ("scale", "power"))


class Sizes(NamedTuple):
    """Laws of both directions, along the normal and across it, at V vertices: size = factor (claimed / USUAL)^power."""

    log_factors: np.ndarray  # (2, V) logarithms of metres
    powers: tuple[float, float]  # of the claimed sizes


def evidence(problem: Problem, estimate: Estimate, position: np.ndarray, patches: PatchStatistics) -> SizeEvidence:
    """The evidence of a frame. One in which nothing is measured has lost all vertices, and its hems are where they were.

    Args:
        problem: the frame.
        estimate: finished.
        position: (V, 3) posterior, metres.
        patches: of the frame.
    """
    model, means = problem.model, patches.means
    measured = estimate.learnable
    count = np.count_nonzero(measured)
    slack, beside, away = body_anchor.slack(problem), estimate.clearance is not None, along_cloth(measured, model)
    clearance = np.clip(estimate.clearance, 0.0, FARTHEST) if beside else 0.0
    seen_hem = estimate.terms.measurement.squared_hem
    return SizeEvidence(
        unmatched=estimate.unmatched if count else 1.0,
        hem=problem.last.drift.hem2 if seen_hem is None else seen_hem,
        clearance=clearance,
        slack=0.0 if slack is None else slack,
        strain=patches.strain,
        slip=max(1.0 / max(least_normal_share(position, some_faces(model.faces)), LEAST_SHARE) - BALL, 0.0),
        offset=sqrt(problem.health.offset),
        distance=0.0 if beside else away,
        free=clearance * away if beside else 0.0,
        turned=means.turned,
        moved=np.sqrt(means.motion2),
        soft=problem.last.strain2,
        blind=0.0 if beside else 1.0 - count / len(measured),
    )


def along_cloth(measured: np.ndarray, model: Model) -> np.ndarray:
    """(V,) metres along the cloth from ``measured`` (V,) vertices, at most FARTHEST_ALONG."""
    distance = np.empty(len(measured))
    if not measured.all():
        kernels.distance_along_cloth(measured, model.start, model.neighbour, model.rest_length, FARTHEST_ALONG, distance)
    else:
        distance[:] = 0.0
    return distance


def at_vertices(found: SizeEvidence, patch: np.ndarray) -> SizeEvidence:
    """The evidence with (V,) of each, at vertices of these patches (V,)."""
    values = (value[patch] if name in OF_PATCHES and np.ndim(value) else value for name, value in found._asdict().items())
    return SizeEvidence(*(np.broadcast_to(value, len(patch)) for value in values))


def sizes(problem: Problem, estimate: Estimate, found: SizeEvidence) -> Sizes:
    """The laws at the vertices of a frame."""
    config, on_body = problem.config, estimate.clearance is not None
    laws = config.normal_error, config.tangential_error
    base = np.log([[law.on_body if on_body else law.hidden, law.seen] for law in laws])
    scale, power = (np.array([values(law) for law in laws]).T for values in (_SCALES, _POWERS))
    log_factors = _log_factors(found, LogLaw(scale, power, base), problem.model.patch, estimate.learnable)
    return Sizes(log_factors, tuple(law.claimed_power for law in laws))


def _log_factors(found: SizeEvidence, law: LogLaw, patch: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(2, V) logarithms of the sizes by both laws.

    Args:
        found: the evidence.
        law: of both directions, its terms in the order of the evidence.
        patch: (V,) of each vertex.
        seen: (V,) bool, vertices that were measured.
    """
    log_factors, by_vertex = np.empty((2, len(patch))), []
    for k, (name, value) in enumerate(found._asdict().items()):
        if isinstance(value, np.ndarray) and name not in OF_PATCHES:
            by_vertex.append(k)
    by_patch = [k for k in range(len(found)) if k not in by_vertex]  # one number for all is the same for each patch
    of_patches, of_vertices = np.empty((len(by_patch), len(found.turned))), np.empty((len(by_vertex), len(patch)))
    terms = by_patch + by_vertex
    for row, k in zip((*of_patches, *of_vertices), terms, strict=True):
        row[:] = found[k]
    law = law._replace(scale=law.scale[terms], power=law.power[terms])
    kernels.log_factors(of_patches, of_vertices, patch, seen, law, log_factors)
    return log_factors


def resized(covariance: np.ndarray, normal: np.ndarray, size: Sizes) -> np.ndarray:
    """(V, 3, 3) the covariance with other sizes along the normal and across it; its shape in the tangent plane stays.

    A size is a standard deviation, across the normal the root mean square of two directions.

    Args:
        covariance: (V, 3, 3) as claimed, m^2.
        normal: (V, 3) unit, of the posterior.
        size: of the errors.
    """
    log_scale, out = np.empty((2, len(normal))), np.empty_like(covariance)
    kernels.variances_by_normal(covariance, normal, log_scale)
    np.log(log_scale, out=log_scale)
    for log_factor, power, claimed in zip(size.log_factors, size.powers, log_scale, strict=True):
        claimed *= 0.5 * (power - 1.0)  # factor (claimed / USUAL)^power / claimed
        claimed += log_factor
        claimed -= power * log(USUAL)
    kernels.resize(covariance, normal, np.exp(log_scale, out=log_scale), out)
    return out

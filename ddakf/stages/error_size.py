"""Size of the error of every vertex along its normal and across it, by laws of evidence (with stage F's covariance).

The covariance analysis of :mod:`ddakf.stages.uncertainty` knows how the update spreads errors. How large they are in all it does
not know: what it claims was wrong by a factor of two to twenty on garments that slide along themselves, where the cloud lies on
the surface all the same. What gives such an error away is known of every frame: hems that do not meet the end of the cloud,
vertices without a partner, cloth that is loose, far from the body or strained, a shape that slips unnoticed. Each law is fitted
to the errors of many garments, ``benchmarks/error_size.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.body import body_anchor
from ddakf.config import NormalError, TangentialError
from ddakf.garment.slippage import least_normal_share
from ddakf.kernels import uncertainty as kernels
from ddakf.kernels.associate import vertex_normals
from ddakf.types import Estimate, Model, Problem

FACES = 1000  # of a garment whose slippage is looked at
LEAST_SHARE = 0.02  # along the normals: of the straightest skirts that the laws were fitted on
BALL = 5.0  # inverse normal share that says nothing of slipping
USUAL = 0.005  # m, claimed error that the laws' bases belong to
FARTHEST = 0.1  # m from the body; more is no worse
FARTHEST_ALONG = 0.6  # m along the cloth; more is no worse


class PatchEvidence(NamedTuple):
    """Evidence of a frame about the error of each patch. L patches."""

    size: np.ndarray  # (L,) vertices
    observed: np.ndarray  # (L,) of them measured
    information: np.ndarray  # (L, 6) 1/m^2 of the measurements, counted as one: xx yy zz xy xz yz
    bend: np.ndarray  # (L,) 1 - |mean normal|^2 of the measurements
    motion2: np.ndarray  # (L,) m^2, mean squared motion, the garment's common one taken out
    innovation2: np.ndarray  # (L,) m^2, mean squared innovation of the measured vertices, the common one taken out
    strain2: np.ndarray  # (L,) mean squared strain of the edges against rest
    strain: np.ndarray  # (V,) of those at each vertex
    isotropic: bool  # the measurements are points, as well known across as along


class SizeEvidence(NamedTuple):
    """Evidence about the size of the error; (V,) each, or one number for all vertices."""

    unmatched: float  # share of the vertices that a sensor may see and that no measurement was found for
    hem: float  # m^2, mean squared distance of hems from where the cloud ends
    unseen: np.ndarray  # share of the vertex's patch that was not measured
    clearance: np.ndarray | float  # m from the body; 0 without one
    slack: np.ndarray | float  # m, standard deviation of the place on the body; 0 without one
    strain: np.ndarray  # mean squared strain of the edges at the vertex
    slip: float  # inverse of the least share of a rigid motion that is along the normals, beyond BALL
    offset: float  # m, RMS distance of the cloud from the surface beyond noise, over the last half second
    distance: np.ndarray | float  # m along the cloth to the nearest measured vertex; 0 beside a body
    reached: np.ndarray | float  # the same beside a body; 0 without one
    turned: np.ndarray  # squared sine of the angle between the surface and its planes, mean of the vertex's patch
    moved: np.ndarray  # m, RMS motion of the patch in this frame, the garment's common one taken out
    soft: float  # squared strain to which the stiffness has adapted
    blind: float  # share of the vertices that were not measured; 0 beside a body


class Sizes(NamedTuple):
    """Laws of both directions at the V vertices of a frame: size = factor (claimed / USUAL)^power."""

    normal: np.ndarray  # (V,) m
    tangential: np.ndarray  # (V,) m
    powers: tuple[float, float]  # of the claimed sizes, along the normal and across it


def evidence(problem: Problem, estimate: Estimate, position: np.ndarray, patches: PatchEvidence) -> SizeEvidence:
    """The evidence of a frame. One in which nothing is measured has lost all vertices, and its hems are where they were.

    Args:
        problem: the frame.
        estimate: finished.
        position: (V, 3) posterior, metres.
        patches: of the frame.
    """
    model = problem.model
    measured = estimate.learnable
    share = np.bincount(model.patch, measured, len(model.likeness)) / np.bincount(model.patch)
    clearance, slack = estimate.clearance, body_anchor.slack(problem)
    beside, away = clearance is not None, _along_cloth(measured, model)
    seen_hem = estimate.evidence.measurement.squared_hem
    faces = model.faces[:: -(-len(model.faces) // FACES)]
    return SizeEvidence(
        unmatched=estimate.unmatched if measured.any() else 1.0,
        hem=problem.last.drift.hem2 if seen_hem is None else seen_hem,
        unseen=1.0 - share[model.patch],
        clearance=np.clip(clearance, 0.0, FARTHEST) if beside else 0.0,
        slack=0.0 if slack is None else slack,
        strain=patches.strain,
        slip=max(1.0 / max(least_normal_share(position, faces), LEAST_SHARE) - BALL, 0.0),
        offset=float(np.sqrt(problem.health.offset)),
        distance=0.0 if beside else away,
        reached=away if beside else 0.0,
        turned=_turned(estimate, position, measured, model),
        moved=np.sqrt(patches.motion2)[model.patch],
        soft=problem.last.strain2,
        blind=0.0 if beside else float(1.0 - measured.mean()),
    )


def _turned(estimate: Estimate, position: np.ndarray, measured: np.ndarray, model: Model) -> np.ndarray:
    """(V,) mean squared sine of the angle between surface and planes over a patch, the garment's where none is measured."""
    normal, n = np.empty_like(position), len(model.likeness)
    vertex_normals(position, model.faces, normal)
    sine2 = np.where(measured, np.clip(1.0 - np.einsum("va,va->v", normal, estimate.planes.normal) ** 2, 0.0, 1.0), 0.0)
    count, total = np.bincount(model.patch, measured, n), np.bincount(model.patch, sine2, n)
    mean = total.sum() / max(count.sum(), 1.0)
    return np.where(count > 0, total / np.maximum(count, 1.0), mean)[model.patch]


def _along_cloth(measured: np.ndarray, model: Model) -> np.ndarray:
    """(V,) metres along the cloth from ``measured`` (V,) vertices, at most FARTHEST_ALONG."""
    distance = np.empty(len(measured))
    if not measured.all():
        kernels.distance_along_cloth(measured, model.start, model.neighbour, model.rest_length, FARTHEST_ALONG, distance)
    else:
        distance[:] = 0.0
    return distance


def sizes(problem: Problem, estimate: Estimate, found: SizeEvidence) -> Sizes:
    """The laws at the vertices of a frame."""
    config, seen, on_body = problem.config, estimate.learnable, estimate.clearance is not None
    along, across = (
        np.where(seen, law.seen, law.on_body if on_body else law.hidden) * _factor(found, law)
        for law in (config.normal_error, config.tangential_error)
    )
    return Sizes(along, across, (config.normal_error.claimed_power, config.tangential_error.claimed_power))


def _factor(found: SizeEvidence, law: NormalError | TangentialError) -> np.ndarray:
    """(V,) prod (1 + evidence / scale)^power, or one number where all evidence is."""
    terms = ((value, getattr(law, f"{name}_scale"), getattr(law, f"{name}_power")) for name, value in found._asdict().items())
    return np.exp(sum(power * np.log(1.0 + value / scale) for value, scale, power in terms if power > 0.0))


def resized(problem: Problem, position: np.ndarray, covariance: np.ndarray, size: Sizes) -> np.ndarray:
    """(V, 3, 3) the covariance with other sizes along the normal and across it; its shape in the tangent plane stays.

    Args:
        problem: the frame.
        position: (V, 3) posterior, metres.
        covariance: (V, 3, 3) as claimed, m^2.
        size: of the errors.
    """
    normal, out = np.empty_like(position), np.empty_like(covariance)
    vertex_normals(position, problem.model.faces, normal)
    kernels.resize(covariance, normal, size, USUAL, out)
    return out

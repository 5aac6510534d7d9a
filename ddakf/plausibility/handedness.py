"""Handedness: garments inside out or of uncertain heading, clouds that curve toward their sensor, and clouds upside down."""

from __future__ import annotations

import numpy as np

from ddakf.mesh import Mesh
from ddakf.types import Estimate, Problem, Sign

SAMPLE = 128  # planes that are looked at
HOLLOW = -0.1  # mean cosine between normals and the directions from the middle; of a standing person it is 0.25


def mirrored(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a mesh whose faces turn the wrong way, or of a cloud that is hollow where its sensor looks."""
    for field, cosine in (("garment", problem.reference.outward), ("body", problem.reference.body_outward)):
        if cosine < HOLLOW:
            what = f"the {field} is inside out, as a mirrored one is"
            return Sign(field, f"{what}: mean cosine of its normals to the outside {cosine:.2f}")
    cloud = problem.cloud
    if problem.frame.sensor_origin is None or not cloud.oriented or cloud.empty or problem.last.view.one_sided:
        return None
    planes = cloud.surfels[:, :: -(-cloud.surfels.shape[1] // SAMPLE)]
    cosine = outwardness(planes[:3].T, planes[3:].T)
    if not cosine <= HOLLOW:
        return None
    return Sign("sensor_origin", f"the cloud is hollow toward its sensor, as a mirrored one is: mean cosine {cosine:.2f}")


def upside_down(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a search that found the garment upside down nearer to the cloud than upright."""
    if problem.overturned is None:
        return None
    upright, over = (1e3 * cost for cost in problem.overturned)
    return Sign("points", f"the garment fits the cloud upside down: {over:.0f} mm off in the mean, upright {upright:.0f} mm")


def heading_uncertain(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a search that found the garment, and as good a fit the other way round."""
    if problem.rival is None:
        return None
    return Sign("garment", f"turned by {abs(problem.rival):.0f} degrees it fits as well: a start tells which way it faces")


def outward(garment: Mesh) -> float:
    """Mean cosine of a garment's normals, those of its faces, to the directions from its middle; by area."""
    corners = garment.vertices[garment.faces]
    return outwardness(corners.mean(axis=1), np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def outwardness(points: np.ndarray, normals: np.ndarray) -> float:
    """Mean cosine of (N, 3) normals to the directions from the middle of (N, 3) points, weighted by their length and distance."""
    weight = np.sqrt(np.einsum("na,na->n", normals, normals))
    away = points - np.einsum("n,na->a", weight, points) / max(float(weight.sum()), 1e-30)
    distance = np.sqrt(np.einsum("na,na->n", away, away))
    return float(np.einsum("na,na->", normals, away) / max(float(weight @ distance), 1e-30))

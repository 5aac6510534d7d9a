"""Orientation: garments inside out or of uncertain heading, clouds that curve toward their sensor, and clouds upside down."""

from __future__ import annotations

import numpy as np

from ddakf.mesh import Mesh
from ddakf.plausibility import units
from ddakf.types import Estimate, Problem, Sign

SAMPLE = 128  # number of planes that are looked at
LYING = 0.6  # height over width of a body, below which it lies
UPRIGHT = 1.8  # height over width of a body, above which it stands straight, with arms at its sides
OVERTURNED, OVERTURNED_WIDE = 0.49, 0.45  # least height of the middle of its surface over a body's height; people have over half
WHOLE = 1.2  # m: a lower body may be a torso, for which OVERTURNED says nothing
HOLLOW = -0.1  # mean cosine between normals and the directions from the middle, below which a shape is hollow; a person has 0.25
TURNED = 0.4  # rad, expected error of the heading from which on it is a warning
FOUND = 0.7  # reliability of a garment, above which its axes are right
OTHER_HEIGHT, SAME_HEIGHT = 1.3, 1.15  # ratio of two heights, from which on they differ, and up to which they are the same
TINY = 1e-6  # m
FITS = 0.35  # reliability of the last frame, above which a hollow shape is right


def mirrored(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a mesh whose faces turn the wrong way, or of a cloud that is hollow where its sensor looks.

    Caps and curtains may be hollow. What is mirrored fits no cloud whose sensor is known, so that what does is right.
    """
    fits = problem.cloud.oriented and problem.health.reliability > FITS
    for field, cosine in (("garment", problem.reference.outward), ("body", problem.reference.body_outward)):
        if cosine < HOLLOW and not (fits and field == "garment"):
            what = f"the {field} is inside out, as a mirrored one is"
            return Sign(field, f"{what}: mean cosine of its normals to the outside {cosine:.2f}")
    cloud = problem.cloud
    if fits or problem.frame.sensor_origin is None or not cloud.oriented or cloud.empty or problem.last.view.one_sided:
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


def wrong_up(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a body that at the start does not stand along the vertical, which gravity and searches go by, or of a garment.

    A garment that is not found may have its height along another axis, as templates of programs whose z points upward have.
    """
    if problem.reference.fallen_body:
        return Sign("config.start.up", problem.reference.fallen_body)
    given, points = problem.resting is not None and problem.resting.given, problem.frame.points
    if given or problem.health.reliability > FOUND or len(points) < units.ENOUGH:
        return None
    to_y_up = problem.config.start.to_y_up
    cloud = units.extents(points @ to_y_up.T)[1]
    garment = np.abs(to_y_up) @ units.extents(problem.model.mesh.vertices)
    over = np.abs(np.log(np.maximum(garment, TINY) / max(cloud, TINY)))
    other = 0 if over[0] < over[2] else 2
    if over[1] < np.log(OTHER_HEIGHT) or over[other] > np.log(SAME_HEIGHT):
        return None
    axis = "xyz"[np.abs(to_y_up[other]).argmax()]
    heights = f"the cloud is {cloud:.2g} m high, the garment {garment[1]:.2g} m, and {garment[other]:.2g} m along its {axis}"
    return Sign("garment", f"{heights}: does that axis of it point upward, or does the wearer lie?")


def fallen(body: Mesh, to_y_up: np.ndarray) -> str:
    """What tells that a body does not stand along the vertical, or on its head, in a sentence; empty: nothing does.

    A standing person is higher than wide, but for arms held out, and more than half of its surface is in its upper half. A body
    of less than ``WHOLE`` metres may be a part of one, such as a torso, of which that is not known.

    Args:
        body: in the pose of the start.
        to_y_up: (3, 3) rows are the axes to the right, upward and to the front.
    """
    corners = body.vertices[body.faces] @ to_y_up.T
    weight = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    lowest = corners.min(axis=(0, 1))
    width, height, depth = corners.max(axis=(0, 1)) - lowest
    widest = max(width, depth)
    if height < LYING * widest:
        return f"the body is {height:.2g} m high and {widest:.2g} m wide: is another axis up, or does it lie?"
    if height < WHOLE:
        return ""
    middle = (float(weight @ corners[:, :, 1].mean(axis=1)) / float(weight.sum()) - lowest[1]) / height
    if middle < (OVERTURNED if height > UPRIGHT * widest else OVERTURNED_WIDE):
        return f"the body stands on its head: the middle of its surface is at {middle:.0%} of its height"
    return ""


def heading_uncertain(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a search that found the garment, and another heading that suits it nearly as well."""
    rival = problem.rival
    if rival is None or rival.expected < TURNED:
        return None
    return Sign("garment", f"turned by {abs(rival.degrees):.0f} degrees it fits about as well: a reset tells which way it faces")


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

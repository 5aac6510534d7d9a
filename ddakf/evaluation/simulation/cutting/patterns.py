"""Patterns of garments: surfaces around the resting body, cut and let hang.

Most begin as the CC0 helper-tights surface around the body: moved outward, cut by planes, made to hang from chest or waist,
and continued where it is a skirt. A hood is a dome over the head, a cape a surface of revolution above the shoulders.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ddakf.data.body import Body
from ddakf.evaluation.simulation.cutting.extensions import hem_loop, hooded, over_shoulders, strip
from ddakf.evaluation.simulation.cutting.outline import ARM_JOINTS, GAP, LEVEL_HEIGHT, Outline, hanging, outside
from ddakf.evaluation.simulation.cutting.remesh import cut, largest_part, subdivided
from ddakf.mesh import Mesh, vertex_normals

SMOOTHINGS = 12  # averages of a vertex with its neighbours: the body's details vanish
NECK_UP = np.array([0.0, 0.85, 0.53])  # normal of the neckline's plane, lower in front
ROUNDING = 0.01  # m, of the corners of necklines and openings
SLEEVE_EASE, LEG_EASE = (0.15, 0.6), (0.05, 0.4)  # share of upper arm and thigh over which a limb's ease begins
APART = 0.012  # m from the middle: nearer, ease does not move a trouser leg towards the other


class Dimensions(NamedTuple):
    """A garment's measures, metres unless said."""

    neck_drop: float = 0.0  # how far the neckline's plane is below the neck
    neck_width: float = 0.0  # half of the opening
    hem_below_pelvis: float = 0.0
    sleeve: float = 0.0  # 1 ends at the elbow, 2 at the wrist
    looseness: float = 0.0  # 0 follows the body, 1 hangs straight from the chest
    length: float = 0.0  # of the skirt, from where it begins
    flare: float = 0.0  # widening per length, no unit
    leg: float = 0.0  # 1 ends at the knee, 2 at the ankle
    opening: float = 0.0  # half of the gap in front
    ease: float = 0.0  # more room around trunk and limbs


def _tshirt(body: Body, size: Dimensions) -> Mesh:
    mesh, arms = _surface(body)
    for side in "lr":
        mesh, arms = _cut(mesh, arms, _before(mesh.vertices, arms, body, side, size.sleeve))
    return _torso(body, mesh, arms, size)


def _tank(body: Body, size: Dimensions) -> Mesh:
    return _torso(body, *_without_arms(body, *_surface(body)), size)


def _dress(body: Body, size: Dimensions) -> Mesh:
    mesh, arms = _without_arms(body, *_surface(body))
    outline = Outline(body)
    return _extended(_torso(body, mesh, arms, size), outline, size.length, size.flare)


def _skirt(body: Body, size: Dimensions) -> Mesh:
    outline = Outline(body)
    mesh = _below_waist(body, outline)
    height = mesh.vertices[:, 1]
    return _extended(largest_part(cut(mesh, height - (outline.waist() - 0.02))), outline, size.length, size.flare)


def _trousers(body: Body, size: Dimensions) -> Mesh:
    mesh = _below_waist(body, Outline(body))
    hip, knee, ankle = (body.head(f"{joint}_l")[1] for joint in ("thigh", "calf", "foot"))
    mesh = cut(mesh, mesh.vertices[:, 1] - np.interp(size.leg, [0, 1, 2], [hip, knee, ankle]))
    return Mesh(outside(_wide_legs(mesh.vertices, body, size.ease), body), mesh.faces)


def _jacket(body: Body, size: Dimensions) -> Mesh:
    mesh = _tshirt(body, size)
    beside, behind = np.abs(mesh.vertices[:, 0]) - size.opening, Outline(body).axis[1] - mesh.vertices[:, 2]
    return largest_part(cut(mesh, ROUNDING * np.logaddexp(beside / ROUNDING, behind / ROUNDING)))


def _hoodie(body: Body, size: Dimensions) -> Mesh:
    mesh = cut(*hooded(_tshirt(body, size), body, GAP, size.opening + size.ease / 2))
    return Mesh(outside(mesh.vertices, body), mesh.faces)


def _cape(body: Body, size: Dimensions) -> Mesh:
    mesh = over_shoulders(body, size.length + 3 * size.ease, size.neck_width, size.opening)
    return Mesh(outside(mesh.vertices, body), mesh.faces)


Pattern = Callable[[Body, Dimensions], Mesh]
GARMENTS: dict[str, tuple[Pattern, Dimensions]] = {
    "tshirt": (_tshirt, Dimensions(neck_drop=0.02, neck_width=0.09, hem_below_pelvis=0.02, sleeve=0.6, looseness=0.8)),
    "tank": (_tank, Dimensions(neck_drop=0.06, neck_width=0.07, hem_below_pelvis=0.0, looseness=0.5)),
    "skirt": (_skirt, Dimensions(length=0.48, flare=0.4)),
    "dress": (_dress, Dimensions(neck_drop=0.06, neck_width=0.07, hem_below_pelvis=-0.06, looseness=0.3, length=0.42, flare=0.3)),
    "long-shirt": (_tshirt, Dimensions(neck_drop=0.02, neck_width=0.08, hem_below_pelvis=0.03, sleeve=1.8, looseness=0.7)),
    "trousers": (_trousers, Dimensions(leg=1.8, ease=0.008)),
    "shorts": (_trousers, Dimensions(leg=0.65, ease=0.012)),
    "straight-skirt": (_skirt, Dimensions(length=0.5, flare=0.08)),
    "jacket": (_jacket, Dimensions(0.03, 0.085, hem_below_pelvis=0.06, sleeve=1.8, looseness=0.9, opening=0.035, ease=0.008)),
    "hoodie": (_hoodie, Dimensions(0.01, 0.07, hem_below_pelvis=0.03, sleeve=1.8, looseness=0.8, opening=0.012, ease=0.004)),
    "cape": (_cape, Dimensions(neck_width=0.085, length=0.36, opening=0.03)),
}  # name: pattern, measures


def _surface(body: Body) -> tuple[Mesh, np.ndarray]:
    """The tights, finer and farther from the body, and which of its vertices (V,) belong to the arms."""
    arms = [index for index, name in enumerate(body.names) if name.startswith(ARM_JOINTS)]
    coarse = Mesh(body.tights.vertices, body.tights.faces)
    mesh, share = subdivided(coarse), body.tights.share(arms)
    share = np.concatenate([share, share[coarse.edges].mean(axis=1)])
    vertices = mesh.vertices + GAP * vertex_normals(mesh.vertices, mesh.faces)
    a, b = mesh.edges.T
    degree = np.bincount(mesh.edges.ravel(), minlength=len(vertices))[:, None]
    for _ in range(SMOOTHINGS):
        total = np.zeros_like(vertices)
        np.add.at(total, a, vertices[b])
        np.add.at(total, b, vertices[a])
        vertices = (vertices + total / degree) / 2
    return Mesh(outside(vertices, body), mesh.faces), share > 0.5


def _without_arms(body: Body, mesh: Mesh, arms: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Cuts armholes: planes that lean from the top of the shoulder to the armpit."""
    shoulder = body.head("upperarm_l")
    across = 0.96 * (np.abs(mesh.vertices[:, 0]) - 0.74 * shoulder[0]) + 0.28 * (mesh.vertices[:, 1] - shoulder[1] - 0.04)
    return _cut(mesh, arms, -across)


def _torso(body: Body, mesh: Mesh, arms: np.ndarray, size: Dimensions) -> Mesh:
    """Cuts neckline and hem, and lets sleeves and the cloth below the armpits hang."""
    neck = body.head("neck_01") - [0.0, size.neck_drop, 0.0]
    below, beside = -(mesh.vertices - neck) @ NECK_UP, np.abs(mesh.vertices[:, 0]) - size.neck_width
    mesh, arms = _cut(mesh, arms, ROUNDING * np.logaddexp(below / ROUNDING, beside / ROUNDING))
    hem = body.head("pelvis")[1] - size.hem_below_pelvis
    mesh, arms = _cut(mesh, arms, np.where(arms, 1.0, mesh.vertices[:, 1] - hem))
    vertices = hanging(mesh.vertices, arms, body, size.looseness, size.ease)
    for side in "lr":
        vertices = _wide_sleeve(vertices, arms, body, side, size.ease)
    return largest_part(Mesh(vertices, mesh.faces))


def _extended(mesh: Mesh, outline: Outline, length: float, flare: float) -> Mesh:
    """Continues a garment from its lowest hem downward: as wide as what hangs from there, and wider by the flare."""
    loop = hem_loop(mesh, min)
    rows = max(1, round(length / LEVEL_HEIGHT))
    start = mesh.vertices[loop]
    offset = start[:, [0, 2]] - outline.axis
    radius = np.linalg.norm(offset, axis=1)
    top = start[:, 1].mean()
    vertices, faces, above = [mesh.vertices], [mesh.faces], np.asarray(loop)
    for row in range(1, rows + 1):
        down = length * row / rows
        level = start - [0.0, down, 0.0]
        grown = np.maximum(outline.hanging(level, top) - outline.hanging(start, top), 0) + flare * down
        level[:, [0, 2]] = outline.axis + offset * ((radius + grown) / radius)[:, None]
        below = np.arange(len(loop)) + sum(map(len, vertices))
        vertices.append(level)
        faces += strip(above, below)
        above = below
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def _below_waist(body: Body, outline: Outline) -> Mesh:
    mesh, _ = _without_arms(body, *_surface(body))
    return largest_part(cut(mesh, outline.waist() + 0.01 - mesh.vertices[:, 1]))


def _before(vertices: np.ndarray, arms: np.ndarray, body: Body, side: str, sleeve: float) -> np.ndarray:
    """(V,) a field that is positive up to where a sleeve ends, and off this arm."""
    first = 0 if sleeve <= 1 else 1
    start, end = (body.head(f"{joint}_{side}") for joint in ("upperarm", "lowerarm", "hand")[first : first + 2])
    along = (vertices - start) @ (end - start) / ((end - start) ** 2).sum()
    this_arm = arms & (np.sign(vertices[:, 0]) == np.sign(start[0]))
    return np.where(this_arm, sleeve - first - along, 1.0)


def _wide_sleeve(vertices: np.ndarray, arms: np.ndarray, body: Body, side: str, ease: float) -> np.ndarray:
    """Moves the cloth around an arm away from its bones."""
    bones = [body.head(f"{joint}_{side}") for joint in ("upperarm", "lowerarm", "hand")]
    this_arm = arms & (np.sign(vertices[:, 0]) == np.sign(bones[0][0]))
    along, away = _from_bones(vertices, bones)
    share = _smooth_step(along, *SLEEVE_EASE) * this_arm
    return vertices + ease * share[:, None] * away


def _wide_legs(vertices: np.ndarray, body: Body, ease: float) -> np.ndarray:
    """Moves the cloth around the legs away from their bones, but not across the middle."""
    result = vertices.copy()
    for side, sign in (("l", 1.0), ("r", -1.0)):
        bones = [body.head(f"{joint}_{side}") for joint in ("thigh", "calf", "foot")]
        along, away = _from_bones(vertices, bones)
        away[:, 1] = 0.0
        share = _smooth_step(along, *LEG_EASE) * (sign * vertices[:, 0] > 0)
        moved = vertices + ease * share[:, None] * away
        inner = np.minimum(sign * vertices[:, 0], APART)
        moved[:, 0] = sign * np.maximum(sign * moved[:, 0], inner)
        result = np.where(share[:, None] > 0, moved, result)
    return result


def _from_bones(vertices: np.ndarray, bones: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(V,) place along a chain of two bones, in bones; (V, 3) unit directions away from it."""
    found = []
    for number, (start, end) in enumerate(pairwise(bones)):
        along = (vertices - start) @ (end - start) / ((end - start) ** 2).sum()
        share = np.clip(along, 0, 1) if number == 0 else np.clip(along, 0, 2)
        away = vertices - start - share[:, None] * (end - start)
        found.append((number + share, away, np.linalg.norm(away, axis=1)))
    nearer = found[1][2] < found[0][2]
    along = np.where(nearer, found[1][0], found[0][0])
    away = np.where(nearer[:, None], found[1][1], found[0][1])
    return along, away / np.linalg.norm(away, axis=1, keepdims=True)


def _smooth_step(values: np.ndarray, start: float, end: float) -> np.ndarray:
    share = np.clip((values - start) / (end - start), 0, 1)
    return share**2 * (3 - 2 * share)


def _cut(mesh: Mesh, arms: np.ndarray, field: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Cuts, and finds the arms' vertices again: a new one is an arm's where the nearest old one is."""
    from scipy.spatial import cKDTree

    result = cut(mesh, field)
    return result, arms[cKDTree(mesh.vertices).query(result.vertices)[1]]

"""Garments cut for the body that ships: T-shirt, tank top, skirt and dress, with open hems, at rest on the resting body.

All begin as the CC0 helper-tights surface around the body: moved outward, cut by planes, made to hang from chest or waist,
continued downward with a flare where it is a skirt, and remeshed to edges of about one length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ddakf.body import proximity
from ddakf.data.body import Body
from ddakf.errors import InvalidArgument
from ddakf.evaluation.simulation.remesh import cut, largest_part, remeshed, subdivided
from ddakf.mesh import Mesh, vertex_normals

GAP = 0.009  # m between body and cloth, at least
ARM_JOINTS = ("upperarm", "lowerarm", "hand")
FEWEST_VERTICES, MOST_VERTICES = 200, 10_000  # allowed range
LEVEL_HEIGHT = 0.01  # m between the levels of the outline
N_DIRECTIONS = 96  # of the outline
BELOW_SHOULDER, BLEND = 0.13, 0.08  # m: where cloth begins to hang free, and over which height
CHAFING_ROUNDS = 10  # of pushing out of the body
SMOOTHINGS = 12  # averages of a vertex with its neighbours: the body's details vanish
NECK_UP = np.array([0.0, 0.85, 0.53])  # normal of the neckline's plane, lower in front
ROUNDING = 0.01  # m, of the neckline's corners


class Dimensions(NamedTuple):
    """A garment's measures, metres unless said."""

    neck_drop: float = 0.0  # how far the neckline's plane is below the neck
    neck_width: float = 0.0  # half of the opening
    hem_below_pelvis: float = 0.0
    sleeve: float = 0.0  # share of the upper arm
    looseness: float = 0.0  # 0 follows the body, 1 hangs straight from the chest
    length: float = 0.0  # of the skirt, from where it begins
    flare: float = 0.0  # widening per length, no unit


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment on the resting body.

    Attributes:
        name: tshirt, tank, skirt or dress.
        mesh: the rest shape, in place on the body.
        pinned: (V,) bool, the waistband that moves with the body; nowhere set where the shoulders hold the garment.
    """

    name: str
    mesh: Mesh
    pinned: np.ndarray


def make(name: str, body: Body, n_vertices: int, seed: int = 0) -> Garment:
    """Cuts a garment.

    Args:
        name: of :data:`GARMENTS`.
        body: that wears it.
        n_vertices: wanted; within a few per cent.
        seed: varies its measures by up to a tenth; 0 leaves them as they are.

    Raises:
        InvalidArgument: no such garment, or a number of vertices out of range.
    """
    size = measures(name, seed)
    if not FEWEST_VERTICES <= n_vertices <= MOST_VERTICES:
        raise InvalidArgument("vertices", f"a number in [{FEWEST_VERTICES}, {MOST_VERTICES}]", str(n_vertices))
    mesh = remeshed(GARMENTS[name][0](body, size), n_vertices)
    mesh = Mesh(_outside(mesh.vertices, body), mesh.faces)
    return Garment(name, mesh, _waistband(mesh) if name == "skirt" else np.zeros(mesh.n_vertices, bool))


def measures(name: str, seed: int = 0) -> Dimensions:
    """A garment's measures: its own for seed 0, otherwise each varied by up to a tenth."""
    if name not in GARMENTS:
        raise InvalidArgument("garment", f"one of {', '.join(GARMENTS)}", name)
    size = GARMENTS[name][1]
    return Dimensions(*(np.random.default_rng(seed).uniform(0.9, 1.1, len(size)) * size)) if seed else size


def _tshirt(body: Body, size: Dimensions) -> Mesh:
    mesh, arms = _surface(body)
    for side in ("l", "r"):
        shoulder, elbow = body.head(f"upperarm_{side}"), body.head(f"lowerarm_{side}")
        along = (mesh.vertices - shoulder) @ (elbow - shoulder) / ((elbow - shoulder) ** 2).sum()
        this_arm = arms & (np.sign(mesh.vertices[:, 0]) == np.sign(shoulder[0]))
        mesh, arms = _cut(mesh, arms, np.where(this_arm, size.sleeve - along, 1.0))
    return _torso(body, mesh, arms, size)


def _tank(body: Body, size: Dimensions) -> Mesh:
    return _torso(body, *_without_arms(body, *_surface(body)), size)


def _dress(body: Body, size: Dimensions) -> Mesh:
    mesh, arms = _without_arms(body, *_surface(body))
    outline = _Outline(body)
    return _extended(_torso(body, mesh, arms, size), outline, size.length, size.flare)


def _skirt(body: Body, size: Dimensions) -> Mesh:
    mesh, _ = _without_arms(body, *_surface(body))
    outline = _Outline(body)
    waist, (_, height, _) = outline.waist(), mesh.vertices.T
    mesh = cut(mesh, height - (waist - 0.02))
    mesh = largest_part(cut(mesh, waist + 0.01 - mesh.vertices[:, 1]))
    return _extended(mesh, outline, size.length, size.flare)


Pattern = Callable[[Body, Dimensions], Mesh]
GARMENTS: dict[str, tuple[Pattern, Dimensions]] = {
    "tshirt": (_tshirt, Dimensions(neck_drop=0.02, neck_width=0.09, hem_below_pelvis=0.02, sleeve=0.6, looseness=0.8)),
    "tank": (_tank, Dimensions(neck_drop=0.06, neck_width=0.07, hem_below_pelvis=0.0, looseness=0.5)),
    "skirt": (_skirt, Dimensions(length=0.48, flare=0.4)),
    "dress": (_dress, Dimensions(neck_drop=0.06, neck_width=0.07, hem_below_pelvis=-0.06, looseness=0.3, length=0.42, flare=0.3)),
}


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
    return Mesh(_outside(vertices, body), mesh.faces), share > 0.5


def _without_arms(body: Body, mesh: Mesh, arms: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Cuts armholes: planes that lean from the top of the shoulder to the armpit."""
    shoulder = body.head("upperarm_l")
    across = 0.96 * (np.abs(mesh.vertices[:, 0]) - 0.74 * shoulder[0]) + 0.28 * (mesh.vertices[:, 1] - shoulder[1] - 0.04)
    return _cut(mesh, arms, -across)


def _torso(body: Body, mesh: Mesh, arms: np.ndarray, size: Dimensions) -> Mesh:
    """Cuts neckline and hem, and lets the cloth below the armpits hang."""
    neck = body.head("neck_01") - [0.0, size.neck_drop, 0.0]
    below, beside = -(mesh.vertices - neck) @ NECK_UP, np.abs(mesh.vertices[:, 0]) - size.neck_width
    mesh, arms = _cut(mesh, arms, ROUNDING * np.logaddexp(below / ROUNDING, beside / ROUNDING))
    hem = body.head("pelvis")[1] - size.hem_below_pelvis
    mesh, arms = _cut(mesh, arms, np.where(arms, 1.0, mesh.vertices[:, 1] - hem))
    mesh = Mesh(_hanging(mesh.vertices, arms, body, size.looseness), mesh.faces)
    return largest_part(mesh)


def _cut(mesh: Mesh, arms: np.ndarray, field: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Cuts, and finds the arms' vertices again: a new one is an arm's where the nearest old one is."""
    from scipy.spatial import cKDTree

    result = cut(mesh, field)
    return result, arms[cKDTree(mesh.vertices).query(result.vertices)[1]]


class _Outline:
    """Extent of the body around its axis: the convex outline of trunk and legs at each height, in every direction."""

    def __init__(self, body: Body):
        from scipy.spatial import ConvexHull

        arms = [index for index, name in enumerate(body.names) if name.startswith((*ARM_JOINTS, "clavicle"))]
        points = body.vertices[body.skin.share(arms) < 0.3]
        self.axis = np.array([0.0, points[np.abs(points[:, 1] - body.head("spine_02")[1]) < 0.02, 2].mean()])
        self.top = body.head("upperarm_l")[1] - BELOW_SHOULDER
        self.heights = np.arange(self.top, body.head("calf_l")[1] - 0.1, -LEVEL_HEIGHT)
        angle = np.linspace(0, 2 * np.pi, N_DIRECTIONS, endpoint=False)
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        self.radius = np.empty((len(self.heights), N_DIRECTIONS))
        for level, height in enumerate(self.heights):
            section = points[np.abs(points[:, 1] - height) < 1.5 * LEVEL_HEIGHT][:, [0, 2]] - self.axis
            hull = ConvexHull(section).equations  # a . p + b <= 0 inside
            along = direction @ hull[:, :2].T
            with np.errstate(divide="ignore"):
                reach = np.where(along > 1e-9, -hull[:, 2] / along, np.inf)
            self.radius[level] = reach.min(axis=1) + GAP

    def waist(self) -> float:
        """Height where the trunk is narrowest, metres."""
        return float(self.heights[self.radius[:40].mean(axis=1).argmin()])

    def hanging(self, vertices: np.ndarray, top: float) -> np.ndarray:
        """(V,) distance from the axis, at each vertex's height and direction, of cloth that hangs straight from ``top``."""
        first = int(np.searchsorted(-self.heights, -top))
        falling = np.maximum.accumulate(self.radius[first:], axis=0)
        level = np.clip((self.heights[first] - vertices[:, 1]) / LEVEL_HEIGHT, 0, len(falling) - 1)
        x, z = (vertices[:, [0, 2]] - self.axis).T
        turn = np.mod(np.arctan2(z, x) / (2 * np.pi) * N_DIRECTIONS, N_DIRECTIONS)
        below, left = level.astype(int), turn.astype(int) % N_DIRECTIONS
        next_level, right = np.minimum(below + 1, len(falling) - 1), (left + 1) % N_DIRECTIONS
        s, t = level - below, turn - np.floor(turn)
        upper = (1 - t) * falling[below, left] + t * falling[below, right]
        lower = (1 - t) * falling[next_level, left] + t * falling[next_level, right]
        return (1 - s) * upper + s * lower


def _hanging(vertices: np.ndarray, arms: np.ndarray, body: Body, looseness: float) -> np.ndarray:
    """Moves the trunk's vertices away from the axis, towards where cloth hangs straight from the chest."""
    outline = _Outline(body)
    offset = vertices[:, [0, 2]] - outline.axis
    radius = np.linalg.norm(offset, axis=1)
    straight = outline.hanging(vertices, outline.top)
    share = looseness * np.clip((outline.top - vertices[:, 1]) / BLEND, 0, 1) * ~arms
    wanted = radius + share * np.maximum(straight - radius, 0)
    result = vertices.copy()
    result[:, [0, 2]] = outline.axis + offset * (wanted / radius)[:, None]
    return result


def _extended(mesh: Mesh, outline: _Outline, length: float, flare: float) -> Mesh:
    """Continues a garment from its lowest hem downward: as wide as what hangs from there, and wider by the flare."""
    loop = _lowest_hem(mesh)
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
        a, b, c, d = above, np.roll(above, -1), np.roll(below, -1), below
        faces += [np.column_stack([b, a, d]), np.column_stack([b, d, c])]
        above = below
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def _lowest_hem(mesh: Mesh) -> list[int]:
    """The vertices of the lowest boundary loop, in the direction of its faces."""
    directed = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).tolist()
    paired = {(b, a) for a, b in directed}
    following = {a: b for a, b in directed if (a, b) not in paired}
    first = min(following, key=lambda vertex: mesh.vertices[vertex, 1])
    loop = [first]
    while (after := following[loop[-1]]) != first:
        loop.append(after)
    return loop


def _waistband(mesh: Mesh) -> np.ndarray:
    """(V,) bool: the uppermost hem."""
    middle = (mesh.vertices[:, 1].min() + mesh.vertices[:, 1].max()) / 2
    return mesh.boundary_vertices & (mesh.vertices[:, 1] > middle)


def _outside(vertices: np.ndarray, body: Body) -> np.ndarray:
    """Pushes vertices that are nearer than the gap to the body, or inside it, straight out."""
    tree = proximity.build(Mesh(body.vertices, body.faces))
    surface = proximity.refresh(tree, body.vertices)
    vertices = np.ascontiguousarray(vertices)
    for _ in range(CHAFING_ROUNDS):
        found = proximity.closest_points(tree, surface, vertices, radius=np.inf)
        near = found.distance < GAP * 0.99
        if not near.any():
            break
        vertices = np.where(near[:, None], found.point + GAP * found.normal, vertices)
    return vertices

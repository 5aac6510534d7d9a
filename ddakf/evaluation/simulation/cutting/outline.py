"""Outline of the body around its axis, by height and direction: how far out cloth hangs."""

from __future__ import annotations

import numpy as np

from ddakf.body import proximity
from ddakf.data.body import Body
from ddakf.mesh import Mesh

GAP = 0.009  # m between body and cloth, at least
ARM_JOINTS = ("upperarm", "lowerarm", "hand")
LEVEL_HEIGHT = 0.01  # m between the levels of the outline
N_DIRECTIONS = 96  # of the outline
BELOW_SHOULDER, BLEND = 0.13, 0.08  # m: where cloth begins to hang free, and over which height
CHAFING_ROUNDS = 10  # of pushing out of the body


class Outline:
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


def hanging(vertices: np.ndarray, arms: np.ndarray, body: Body, looseness: float, ease: float = 0.0) -> np.ndarray:
    """Moves the trunk's vertices away from the axis, towards where cloth hangs straight from the chest, and by the ease (m)."""
    outline = Outline(body)
    offset = vertices[:, [0, 2]] - outline.axis
    radius = np.linalg.norm(offset, axis=1)
    straight = outline.hanging(vertices, outline.top)
    free = np.clip((outline.top - vertices[:, 1]) / BLEND, 0, 1) * ~arms
    wanted = radius + free * (looseness * np.maximum(straight - radius, 0) + ease)
    result = vertices.copy()
    result[:, [0, 2]] = outline.axis + offset * (wanted / radius)[:, None]
    return result


def outside(vertices: np.ndarray, body: Body) -> np.ndarray:
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

"""Surfaces of garments that are not the body's own: a hood above a neckline, and a cape."""

from __future__ import annotations

import numpy as np

from ddakf.data.body import Body
from ddakf.mesh import Mesh

HOOD_ROWS = 24  # from the neckline to the crown
HOOD_BLEND = 0.35  # share of the way up over which the hood widens from the neckline to the head
FACE = np.array([0.0, -0.12, 0.99])  # direction of the face's opening from the middle of the head
FACE_ANGLE = 47.0  # degrees from it that are open
CAPE_STEP = 0.01  # m between the rows of a cape
CAPE_COLUMNS = 120
ABOVE_SHOULDERS, BEHIND_NECK = 0.015, 0.009  # m of a cape above what is below it; of its axis before that of the neck


def hooded(mesh: Mesh, body: Body, gap: float, room: float) -> tuple[Mesh, np.ndarray]:
    """Adds a hood that is worn, from the neckline up over the head; and a field (V,) that is negative before the face.

    Args:
        mesh: a top whose highest hem is the neckline.
        body: at rest.
        gap, room: between head and hood at least, and further, metres.
    """
    head = body.vertices[body.skin.share([body.index("head")]) > 0.5]
    centre = (head.min(axis=0) + head.max(axis=0)) / 2
    reach = _Hull(head - centre)
    loop = hem_loop(mesh, max)
    start = mesh.vertices[loop] - centre
    distance = np.linalg.norm(start, axis=1)
    azimuth, elevation = np.arctan2(start[:, 2], start[:, 0]), np.arcsin(start[:, 1] / distance)
    rows, faces, above = [mesh.vertices], [mesh.faces], np.asarray(loop)
    for row in range(1, HOOD_ROWS):
        share = row / HOOD_ROWS
        up = elevation + share * (np.pi / 2 - elevation)
        direction = np.column_stack([np.cos(up) * np.cos(azimuth), np.sin(up), np.cos(up) * np.sin(azimuth)])
        blend = np.clip(share / HOOD_BLEND, 0, 1)[..., None]
        radius = (1 - blend) * distance + blend * (reach(direction) + gap + room)
        below = np.arange(len(loop)) + sum(map(len, rows))
        rows.append(centre + direction * radius[:, None])
        faces += strip(above, below)
        above = below
    crown = sum(map(len, rows))
    rows.append(centre[None] + [[0.0, reach(np.array([[0.0, 1.0, 0.0]]))[0] + gap + room, 0.0]])
    faces.append(np.column_stack([np.roll(above, -1), above, np.full(len(loop), crown)]))
    vertices = np.concatenate(rows)
    hood = np.arange(len(vertices)) >= mesh.n_vertices
    toward = vertices - centre
    angle = np.degrees(np.arccos(np.clip(toward @ FACE / np.linalg.norm(toward, axis=1) / np.linalg.norm(FACE), -1, 1)))
    return Mesh(vertices, np.concatenate(faces)), np.where(hood, angle - FACE_ANGLE, 1.0)


def over_shoulders(body: Body, length: float, neck: float, opening: float) -> Mesh:
    """A cape: of one radius at each height, above shoulders and arms, open in front.

    Args:
        body: at rest.
        length: along the cloth from the neck down, metres.
        neck: radius of the neckline, metres.
        opening: half of the gap in front, metres.
    """
    head = body.skin.share([body.index("head"), body.index("neck_01")]) > 0.5
    axis = body.head("neck_01")[[0, 2]] + [0.0, BEHIND_NECK]
    distance, height = np.linalg.norm(body.vertices[~head][:, [0, 2]] - axis, axis=1), body.vertices[~head, 1]
    radii = np.arange(neck, neck + length, CAPE_STEP)
    tops = np.array([height[distance >= radius].max(initial=height.min()) for radius in radii]) + ABOVE_SHOULDERS
    profile = _above(np.column_stack([radii, tops]))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    places = np.linspace(0, length, round(length / CAPE_STEP) + 1)
    radius, height = (np.interp(places, along, part) for part in profile.T)
    gap = np.arcsin(np.minimum(opening / radius, 0.9))[:, None]
    turn = np.pi / 2 + gap + (2 * np.pi - 2 * gap) * np.linspace(0, 1, CAPE_COLUMNS)
    x, z = axis[0] + radius[:, None] * np.cos(turn), axis[1] + radius[:, None] * np.sin(turn)
    vertices = np.stack([x, np.broadcast_to(height[:, None], x.shape), z], axis=2).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = [np.stack(corners, axis=2).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    return Mesh(vertices, np.concatenate(faces))


class _Hull:
    """How far the convex hull of points around the origin reaches in a direction."""

    def __init__(self, points: np.ndarray):
        from scipy.spatial import ConvexHull

        self._planes = ConvexHull(points).equations  # a . p + b <= 0 inside

    def __call__(self, direction: np.ndarray) -> np.ndarray:
        along = direction @ self._planes[:, :3].T
        with np.errstate(divide="ignore"):
            return np.where(along > 1e-9, -self._planes[:, 3] / along, np.inf).min(axis=1)


def _above(points: np.ndarray) -> np.ndarray:
    """The upper hull of points (N, 2), from left to right."""
    chain: list[np.ndarray] = []
    for point in points:
        while len(chain) > 1 and _left_of(chain[-2], chain[-1], point):
            chain.pop()
        chain.append(point)
    return np.array(chain)


def _left_of(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> bool:
    along, beside = end - start, point - start
    return along[0] * beside[1] - along[1] * beside[0] >= 0


def strip(above: np.ndarray, below: np.ndarray) -> list[np.ndarray]:
    """Faces between two loops of as many vertices, wound as the faces at the first one."""
    a, b, c, d = above, np.roll(above, -1), np.roll(below, -1), below
    return [np.column_stack([b, a, d]), np.column_stack([b, d, c])]


def hem_loop(mesh: Mesh, extreme) -> list[int]:
    """The boundary loop with the lowest vertex (``min``) or the highest one (``max``), in the direction of its faces."""
    directed = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).tolist()
    paired = {(b, a) for a, b in directed}
    following = {a: b for a, b in directed if (a, b) not in paired}
    first = extreme(following, key=lambda vertex: mesh.vertices[vertex, 1])
    loop = [first]
    while (after := following[loop[-1]]) != first:
        loop.append(after)
    return loop

"""Polygons of a mesh file as triangles."""

from __future__ import annotations

import numpy as np

MOST_CORNERS = 500  # of a polygon whose ears are searched, which takes seconds at worst; a larger one is fanned


def triangles(vertices: np.ndarray, polygons: list[np.ndarray]) -> np.ndarray:
    """(F, 3) int64 triangles of polygons.

    A convex polygon is fanned from its first corner. Of one that is not, such as a neckline, ears are cut (Meisters 1975).

    Args:
        vertices: (V, 3).
        polygons: groups (polygons, corners) of indices, which may be out of range: such polygons are fanned.
    """
    parts = [np.zeros((0, 3), np.int64)]
    for group in polygons:
        group = group.astype(np.int64)
        fan = np.stack([group[:, [0, k, k + 1]] for k in range(1, group.shape[1] - 1)], axis=1)  # (polygons, corners - 2, 3)
        within = (group.min(axis=1) >= 0) & (group.max(axis=1) < len(vertices)) & (3 < group.shape[1] <= MOST_CORNERS)
        corners = vertices[fan[within]]
        doubled = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        turned = np.zeros(len(group), bool)
        turned[within] = (np.einsum("pfa,pa->pf", doubled, doubled.sum(axis=1)) < 0.0).any(axis=1)
        parts.append(fan[~turned].reshape(-1, 3))
        parts += [_ears(vertices, polygon) for polygon in group[turned]]
    return np.concatenate(parts)


def _ears(vertices: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(corners - 2, 3) triangles of a polygon (corners,), in the plane of its mean normal (Newell)."""
    place = vertices[polygon] - vertices[polygon].mean(axis=0)
    normal = np.cross(place, np.roll(place, -1, axis=0)).sum(axis=0)
    first = np.linalg.svd(normal[None])[2][1]
    plane = place @ np.stack([first, np.cross(normal / np.linalg.norm(normal), first)], axis=1)
    left, found = list(range(len(polygon))), []
    while len(left) > 3:
        ear = next((k for k in range(len(left)) if _is_ear(plane[left], k)), 0)  # of one that crosses itself the first
        found.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return polygon[np.array([*found, left])]


def _is_ear(plane: np.ndarray, k: int) -> bool:
    """Whether corner ``k`` of a polygon (n, 2) is convex, and the triangle of it and its neighbours holds no other corner."""
    n = len(plane)
    around = [k - 1 if k else n - 1, k, (k + 1) % n]
    a, b, c = plane[around]
    if _side(a, b, c) <= 0.0:
        return False
    others = np.delete(plane, around, axis=0)
    inside = (_side(a, b, others) >= 0.0) & (_side(b, c, others) >= 0.0) & (_side(c, a, others) >= 0.0)
    return not (inside & (others != a).any(axis=1) & (others != c).any(axis=1)).any()


def _side(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Twice the area of the triangles a, b, point (..., 2): positive where the point lies left of the line from a to b."""
    along, off = b - a, point - a
    return along[0] * off[..., 1] - along[1] * off[..., 0]

"""Adversarial frames: valid clouds and poses whose geometry would make a stage slow, beside spread ones of the same size."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

FAR, NEAR = 1e3, 1e-6  # m: scales at which a cloud or a mesh is no garment
WALL = 0.09  # m: surfaces at the rim of the widest gate

Shape = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]


class Scene(NamedTuple):
    """What a hostile client sends, frame after frame."""

    cloud: Shape  # (M, 3) points seen and (V, 3) vertices of the garment to (M, 3) metres
    garment: Shape | None = None  # the same vertices to those of a reset; None: no reset
    body: Shape | None = None  # (B, 3) vertices of the body to those of the frame; None: as it is


def seen(points, vertices, rng):
    """The cloud that the sensor saw."""
    return points


def _moved(shift) -> Shape:
    return lambda points, vertices, rng: points + shift


def _shaken(points, vertices, rng):
    """The cloud up to 5 cm away, to another side in each frame: all passes are needed."""
    return points + rng.choice([-1.0, 1.0], 3) * rng.uniform(0.02, 0.03, 3)


def _elsewhere(points, vertices, rng):
    """The cloud at another place in each frame: it is searched again and again."""
    return points + rng.choice([-1.0, 1.0], 3) * rng.uniform(1.0, 2.0, 3)


def _scattered(points, vertices, rng):
    """All through the garment's box."""
    return rng.uniform(vertices.min(axis=0), vertices.max(axis=0), points.shape)


def _clumps(count: int, size: float) -> Shape:
    """Clumps of a size in metres at some of the vertices, equally many points in each."""

    def shape(points, vertices, rng):
        at = vertices[rng.choice(len(vertices), count)]
        return at[np.arange(len(points)) % count] + size * rng.uniform(-0.5, 0.5, points.shape)

    return shape


def _beside(share: float, other: Shape) -> Shape:
    """Some of the cloud, and another shape for the rest."""

    def shape(points, vertices, rng):
        first = round(share * len(points))
        return np.concatenate([points[:first], other(points[first:], vertices, rng)])

    return shape


def _collinear(points, vertices, rng):
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return low + rng.random((len(points), 1)) * (high - low)


def _scaled(factor: float) -> Shape:
    def shape(points, vertices, rng):
        middle = vertices.mean(axis=0)
        return middle + factor * (points - middle)

    return shape


def _blob(points, vertices, rng):
    """A ball without surface, as dense as a stage sees it: eight times what the garment's area takes in its cells."""
    at = vertices[len(vertices) // 2]
    offset = rng.normal(size=points.shape)
    offset *= rng.random((len(points), 1)) ** (1 / 3) / np.linalg.norm(offset, axis=1, keepdims=True)
    return at + 0.06 * offset


def _walls(points, vertices, rng):
    """A hollow cube around the middle of the garment: everything is equally far from there."""
    points = rng.uniform(-WALL, WALL, points.shape)
    points[np.arange(len(points)), rng.integers(0, 3, len(points))] = WALL * rng.choice([-1.0, 1.0], len(points))
    return vertices.mean(axis=0) + points


def _sheets(points, vertices, rng):
    """A stack of sheets across the garment, whose normals agree with none of its vertices'."""
    points = _scattered(points, vertices, rng)
    points[:, 1] = np.round(points[:, 1] / 0.04) * 0.04
    return points


def _point(points, vertices, rng):
    return np.tile(vertices.mean(axis=0), (len(points), 1))


def _folded(points, vertices, rng):
    """All but one at one point: a box as large as before, with everything in one cell of it."""
    folded = np.tile(points.mean(axis=0), (len(points), 1))
    folded[[0, -1]] = points.min(axis=0), points.max(axis=0)
    return folded


def _folded_astray(points, vertices, rng):
    """The same with one vertex a kilometre away."""
    folded = _folded(points, vertices, rng)
    folded[0] += FAR
    return folded


SPREAD = {
    "tracked": Scene(seen),
    "beside": Scene(_moved([0.05, 0.0, 0.03])),
    "shaken": Scene(_shaken),
    "elsewhere": Scene(_elsewhere),
}
CLOUDS = {
    "scattered": Scene(_scattered),
    "coincident": Scene(_clumps(1, 0.0)),
    "coincident, far away": Scene(lambda points, vertices, rng: _point(points, vertices, rng) + FAR),
    "in one cell": Scene(_clumps(1, 1e-3)),
    "in a ball": Scene(_blob),
    "two points": Scene(_clumps(2, 0.0)),
    "two far clusters": Scene(_beside(0.5, lambda points, vertices, rng: points + FAR)),
    "a hundred clumps": Scene(_clumps(100, 2e-3)),
    "a thousand clumps": Scene(_clumps(1000, 1e-3)),
    "half duplicates": Scene(_beside(0.5, _clumps(1, 0.0))),
    "a tenth, and duplicates": Scene(_beside(0.1, _clumps(1, 0.0))),
    "half in a ball": Scene(_beside(0.5, _blob)),
    "collinear": Scene(_collinear),
    "1 um": Scene(_scaled(NEAR)),
    "1 km": Scene(_scaled(FAR)),
    "hollow cube": Scene(_walls),
    "sheets": Scene(_sheets),
}
GARMENTS = {
    "garment folded": Scene(seen, garment=_folded),
    "garment on a point": Scene(seen, garment=_point),
    "garment folded, astray": Scene(seen, garment=_folded_astray),
    "garment folded, hollow cube": Scene(_walls, garment=_point),
    "garment folded, coincident": Scene(_clumps(1, 0.0), garment=_folded),
    "garment 1 um": Scene(seen, garment=_scaled(NEAR)),
    "garment 1 km": Scene(seen, garment=_scaled(FAR)),
}
BODIES = {
    "body folded": Scene(seen, body=_folded),
    "body folded, cloud scattered": Scene(_scattered, body=_folded),
    "body and garment folded": Scene(_scattered, garment=_folded, body=_folded),
    "garment folded on a body": Scene(_scattered, garment=_folded),
    "body far away": Scene(seen, body=_moved([100.0, 0.0, 0.0])),
}


def drawn(body: bool, rng: np.random.Generator) -> tuple[str, Scene]:
    """Two clouds in one at a random share and scale, and a garment and a body in any state; with a name that says them."""
    clouds, garments, bodies = (list(CLOUDS | SPREAD), ["", *GARMENTS], ["", *(BODIES if body else ())])
    first, second, garment, under = rng.choice(clouds), rng.choice(clouds), rng.choice(garments), rng.choice(bodies)
    share, scale = rng.choice([0.01, 0.1, 0.5, 0.9]), rng.choice([1e-3, 0.1, 1.0, 1.0, 1.0, 10.0])

    def cloud(points, vertices, rng):
        count, middle = round(share * len(points)), vertices.mean(axis=0)
        one = (CLOUDS | SPREAD)[first].cloud(points[:count], vertices, rng)
        two = (CLOUDS | SPREAD)[second].cloud(points[count:], vertices, rng)
        return middle + scale * (np.concatenate([one, two]) - middle)

    name = f"{share:g} {first} + {second}, times {scale:g}"
    scene = Scene(cloud, GARMENTS[garment].garment if garment else None, BODIES[under].body if under else None)
    return ", ".join(part for part in (name, garment, under) if part), scene


def scenes(body: bool) -> Iterator[tuple[str, Scene]]:
    """All but the spread ones by name; those of bodies only for a garment on one."""
    yield from (CLOUDS | GARMENTS | (BODIES if body else {})).items()

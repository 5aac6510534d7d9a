"""Shapes of the body: lengths, breadths and girths of its parts, changed at rest along the rig.

Each joint has a linear map S_j about its place, in axes of the bone for limbs and of the world for the trunk. Joints are
chained, h'_child = h'_parent + S_parent (h_child - h_parent); a vertex follows its joints, v' = sum_j w_j (h'_j + S_j (v - h_j)).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace

import numpy as np

from ddakf.data.body import Body, Skin
from ddakf.errors import InvalidArgument

LIMBS = {
    "thigh": ("calf", "legs"),
    "calf": ("foot", "legs"),
    "upperarm": ("lowerarm", "arms"),
    "lowerarm": ("hand", "arms"),
}  # fmt: skip ; bone: the joint where it ends, and its length's field
SMALLEST, LARGEST = 0.5, 2.0  # of a factor
STREAM = 1  # of random numbers: a body does not vary with what else has the same seed


@dataclass(frozen=True)
class BodyShape:
    """Factors on the measures of the body that ships, no unit; all ones leave it unchanged.

    Attributes:
        stature: of the whole body.
        trunk, legs, arms: lengths.
        shoulders, hips: breadths.
        depth: of the trunk, from back to front.
        limbs: girth of arms and legs; thighs are no wider than the hips have room for.
    """

    stature: float = 1.0
    trunk: float = 1.0
    legs: float = 1.0
    arms: float = 1.0
    shoulders: float = 1.0
    hips: float = 1.0
    depth: float = 1.0
    limbs: float = 1.0

    def __post_init__(self) -> None:
        for field, value in asdict(self).items():
            if not SMALLEST <= value <= LARGEST:
                raise InvalidArgument(f"body_shape.{field}", f"a factor in [{SMALLEST:g}, {LARGEST:g}]", f"{value:g}")

    @classmethod
    def from_array(cls, factors: np.ndarray) -> BodyShape:
        """The inverse of :meth:`to_array`.

        Raises:
            InvalidArgument: another number of factors, or one out of range.
        """
        if factors.shape != (expected := (len(fields(cls)),)):
            raise InvalidArgument("body_shape", f"factors of shape {expected}", str(factors.shape))
        return cls(*(float(factor) for factor in factors))

    def to_array(self) -> np.ndarray:
        """(8,) float32 factors in the order of the fields."""
        return np.array(list(asdict(self).values()), np.float32)


PLAIN = BodyShape()
RANGES = {
    "stature": (0.94, 1.12),
    "trunk": (0.96, 1.05),
    "legs": (0.94, 1.07),
    "arms": (0.95, 1.06),
    "shoulders": (0.96, 1.15),
    "hips": (0.97, 1.16),
    "depth": (0.95, 1.2),
    "limbs": (0.93, 1.15),
}  # fmt: skip ; of random shapes


def random_shape(seed: int) -> BodyShape:
    """A shape with every factor drawn within :data:`RANGES`; float32, as files store it. Seed 0: the body that ships."""
    if not seed:
        return PLAIN
    random = np.random.default_rng((STREAM, seed))
    drawn = {field: np.float32(random.uniform(*limits)) for field, limits in RANGES.items()}
    return replace(PLAIN, **{field: float(value) for field, value in drawn.items()})


def shaped(body: Body, shape: BodyShape) -> Body:
    """The body at rest with other measures, its soles as high as before; the same rig, faces and weights."""
    if shape == PLAIN:
        return body
    maps = np.array([shape.stature * _map(body, joint, shape) for joint in range(len(body.names))])
    heads = np.empty_like(body.heads)
    for joint, parent in enumerate(body.parents):
        bone = body.heads[joint] - body.heads[parent]
        heads[joint] = body.heads[joint] if parent < 0 else heads[parent] + maps[parent] @ bone
    moved = [_moved(skin, body.heads, heads, maps) for skin in (body.skin, body.tights)]
    lift = np.array([0.0, body.vertices[:, 1].min() - moved[0][:, 1].min(), 0.0])
    skins = [replace(skin, vertices=vertices + lift) for skin, vertices in zip((body.skin, body.tights), moved, strict=True)]
    return Body(body.names, body.parents, heads + lift, *skins)


def _map(body: Body, joint: int, shape: BodyShape) -> np.ndarray:
    """(3, 3) linear map of a joint's surroundings, without the stature."""
    name, _, side = body.names[joint].partition("_")
    if name in LIMBS:
        end, length = LIMBS[name]
        along = body.head(f"{end}_{side}") - body.heads[joint]
        along /= np.linalg.norm(along)
        girth = min(shape.limbs, shape.hips) if length == "legs" else shape.limbs
        return girth * np.eye(3) + (getattr(shape, length) - girth) * np.outer(along, along)
    middle = (shape.shoulders + shape.hips) / 2
    breadth = {"pelvis": shape.hips, "spine_01": shape.hips, "spine_02": middle, "spine_03": shape.shoulders}
    if body.names[joint] in breadth:
        return np.diag([breadth[body.names[joint]], shape.trunk, shape.depth])
    return np.diag([shape.shoulders, 1.0, 1.0]) if name == "clavicle" else np.eye(3)


def _moved(skin: Skin, heads: np.ndarray, new_heads: np.ndarray, maps: np.ndarray) -> np.ndarray:
    offset = skin.vertices[:, None] - heads[skin.joints]
    places = new_heads[skin.joints] + np.einsum("vkab,vkb->vka", maps[skin.joints], offset)
    return np.einsum("vk,vka->va", skin.weights, places)

"""The body that ships with ddakf: MakeHuman's (CC0), with a rig and skinning weights; metres, y up, facing +z.

Linear blend skinning: v = sum_j w_j (R_j (v_0 - h_j) + t_j), h_j the joint's place at rest, R_j and t_j the chain of
rotations from the root down to it (Magnenat-Thalmann et al. 1988).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ddakf.data.rotation import rotation_matrices
from ddakf.errors import InvalidArgument

BODY = Path(__file__).with_name("body.npz")
POSITION_STEP = 2.0**-13  # m
WEIGHT_STEPS = 255
INFLUENCES = 4  # joints that move a vertex


@dataclass(frozen=True, eq=False)
class Skin:
    """Vertices that move with a skeleton.

    Attributes:
        vertices: (V, 3) at rest, metres.
        faces: (F, 3) int64, counter-clockwise seen from outside.
        joints: (V, 4) int64, which joints move a vertex.
        weights: (V, 4), how much; each row sums to one.
    """

    vertices: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    weights: np.ndarray

    def share(self, joints: list[int]) -> np.ndarray:
        """(V,) how much of a vertex belongs to some joints, in [0, 1]."""
        return np.where(np.isin(self.joints, joints), self.weights, 0.0).sum(axis=1)


@dataclass(frozen=True, eq=False)
class Pose:
    """Joint rotations and the place of the root over T frames.

    Attributes:
        rotations: (T, J, 3) rotation vectors about the axes of the world, as the body stands at rest, radians; zero is the
            rest pose, an A with the arms at about 45 degrees.
        shift: (T, 3) of the whole body, metres.
    """

    rotations: np.ndarray
    shift: np.ndarray

    def __len__(self) -> int:
        return len(self.shift)


@dataclass(frozen=True, eq=False)
class Body:
    """A skeleton of J joints with its skin.

    Attributes:
        names: of the joints; ``pelvis``, the root, is the first, parents come before children.
        parents: (J,) int64, -1 for the root.
        heads: (J, 3) places of the joints at rest, metres.
        skin: the body's surface, closed.
        tights: a smooth surface just around it, open at the neck, from which garments are cut.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    heads: np.ndarray
    skin: Skin
    tights: Skin

    @property
    def vertices(self) -> np.ndarray:
        """(B, 3) of the skin at rest, metres."""
        return self.skin.vertices

    @property
    def faces(self) -> np.ndarray:
        """(G, 3) of the skin."""
        return self.skin.faces

    def head(self, name: str) -> np.ndarray:
        """(3,) place of a joint at rest, metres."""
        return self.heads[self.index(name)]

    def index(self, name: str) -> int:
        """Number of a joint."""
        if name not in self.names:
            raise InvalidArgument("joint", f"one of {', '.join(self.names)}", name)
        return self.names.index(name)

    def pose(self, rotations: Mapping[str, np.ndarray], shift: np.ndarray) -> Pose:
        """A pose from the rotation vectors (T, 3) of the joints that move, and the shift (T, 3)."""
        every = np.zeros((len(shift), len(self.names), 3))
        for name, vectors in rotations.items():
            every[:, self.index(name)] = vectors
        return Pose(every, np.asarray(shift, np.float64))

    def transforms(self, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        """Chained rotations (T, J, 3, 3) and places of the joints (T, J, 3), metres."""
        n_frames, n_joints = pose.rotations.shape[:2]
        local = rotation_matrices(pose.rotations)
        turn, place = np.empty((n_frames, n_joints, 3, 3)), np.empty((n_frames, n_joints, 3))
        for j, parent in enumerate(self.parents):
            if parent < 0:
                turn[:, j], place[:, j] = local[:, j], self.heads[j] + pose.shift
            else:
                turn[:, j] = turn[:, parent] @ local[:, j]
                place[:, j] = place[:, parent] + turn[:, parent] @ (self.heads[j] - self.heads[parent])
        return turn, place

    def skinned(self, pose: Pose, skin: Skin | None = None) -> np.ndarray:
        """(T, V, 3) float32 vertices in every frame of a pose, metres.

        Args:
            pose: of T frames.
            skin: what moves with the skeleton; default the body's own.
        """
        skin = self.skin if skin is None else skin
        turn, place = self.transforms(pose)
        offset = place - np.einsum("tjab,jb->tja", turn, self.heads)
        result = np.empty((len(pose), len(skin.vertices), 3), np.float32)
        for frame, (rotation, translation) in enumerate(zip(turn, offset, strict=True)):
            blended = np.einsum("vk,vkab->vab", skin.weights, rotation[skin.joints])
            moved = np.einsum("vab,vb->va", blended, skin.vertices)
            result[frame] = moved + np.einsum("vk,vka->va", skin.weights, translation[skin.joints])
        return result

    def attach(self, vertices: np.ndarray, faces: np.ndarray) -> Skin:
        """Lets vertices (V, 3) near the body at rest move with it: each with the weights of the nearest vertex of the skin."""
        from scipy.spatial import cKDTree

        nearest = cKDTree(self.vertices).query(vertices)[1]
        return Skin(np.asarray(vertices), faces, self.skin.joints[nearest], self.skin.weights[nearest])


@cache
def load_body(path=BODY) -> Body:
    """Reads a packed body, which ``ddakf.data.pack_body`` writes; by default the one that ships."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = {key: archive[key] for key in archive.files}
    skin, tights = (_skin(arrays, name) for name in ("body", "tights"))
    names = tuple(str(name) for name in arrays["joint_names"])
    heads = arrays["joint_heads"].astype(np.float64)
    return Body(names, arrays["joint_parents"].astype(np.int64), heads, skin, tights)


def _skin(arrays: dict[str, np.ndarray], name: str) -> Skin:
    faces, joints = (arrays[f"{name}_{part}"].astype(np.int64) for part in ("faces", "joints"))
    return Skin(arrays[f"{name}_vertices"] * POSITION_STEP, faces, joints, arrays[f"{name}_weights"] / WEIGHT_STEPS)

"""The body model SMPL (Loper et al. 2015), from arrays that its licence does not let us ship.

An ``.npz`` with ``v_template (B, 3)``, ``shapedirs (B, 3, betas)``, ``posedirs (B, 3, 9 (J - 1))``, ``J_regressor (J, B)``,
``weights (B, J)``, ``kintree_table (2, J)`` and ``f (F, 3)``, as the model's pickle names them. That pickle is never read:
unpickling runs any code in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddakf.data.rotation import rotation_matrices
from ddakf.errors import InvalidFile
from ddakf.files.sequence import UNREADABLE, why

CHUNK = 64  # poses at once: a few hundred megabytes at most
FIELDS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")


@dataclass(frozen=True, eq=False)
class Smpl:
    """The model's arrays, see the module; ``parents`` (J,) int with -1 for the root."""

    template: np.ndarray
    shape_directions: np.ndarray
    pose_directions: np.ndarray
    joint_regressor: np.ndarray
    weights: np.ndarray
    parents: np.ndarray
    faces: np.ndarray

    def __call__(self, poses: np.ndarray, shape: np.ndarray) -> np.ndarray:
        """(T, B, 3) float32 vertices, metres, the root joint at the origin.

        Args:
            poses: (T, 3 J) rotation vectors of the joints, radians.
            shape: (betas,), as many as there are shape directions or fewer.
        """
        shaped = self.template + self.shape_directions[:, :, : len(shape)] @ shape
        joints = self.joint_regressor @ shaped
        parts = [self._posed(poses[first : first + CHUNK], shaped, joints) for first in range(0, len(poses), CHUNK)]
        return np.concatenate(parts)

    def _posed(self, poses: np.ndarray, shaped: np.ndarray, joints: np.ndarray) -> np.ndarray:
        n, count = len(poses), len(joints)
        rotation = rotation_matrices(poses.reshape(n, count, 3))
        bent = (rotation[:, 1:] - np.eye(3)).reshape(n, -1)
        vertices = shaped + np.einsum("bak,tk->tba", self.pose_directions, bent, optimize=True)
        turn, place = np.empty((n, count, 3, 3)), np.empty((n, count, 3))
        turn[:, 0], place[:, 0] = rotation[:, 0], 0.0
        for j in range(1, count):
            parent = self.parents[j]
            turn[:, j] = turn[:, parent] @ rotation[:, j]
            place[:, j] = place[:, parent] + turn[:, parent] @ (joints[j] - joints[parent])
        shift = place - np.einsum("tjab,jb->tja", turn, joints)  # of the rest shape in the axes of a joint
        blended = np.einsum("bj,tjc->tbc", self.weights, turn.reshape(n, count, 9), optimize=True).reshape(n, -1, 3, 3)
        moved = np.einsum("tbac,tbc->tba", blended, vertices) + np.einsum("bj,tja->tba", self.weights, shift, optimize=True)
        return moved.astype(np.float32)


def load_smpl(path) -> Smpl:
    """Reads the model's arrays.

    Raises:
        InvalidFile: no such file, a pickle, a missing array, shapes that do not fit.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz" or not path.is_file():
        expected = f"an .npz of the arrays {', '.join(FIELDS)} (numpy.savez; no pickle is read)"
        raise InvalidFile(str(path), expected, path.suffix if path.exists() else "nothing there")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in FIELDS}
    except UNREADABLE as error:
        raise InvalidFile(str(path), f"an .npz of {', '.join(FIELDS)}", why(error)) from error
    vertices, joints = len(np.atleast_1d(arrays["v_template"])), np.atleast_1d(arrays["kintree_table"]).shape[-1]
    shapes = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, None),
        "posedirs": (vertices, 3, 9 * (joints - 1)),
        "J_regressor": (joints, vertices),
        "weights": (vertices, joints),
        "kintree_table": (2, joints),
        "f": (None, 3),
    }
    for name, shape in shapes.items():
        found = arrays[name].shape
        if 0 in found or len(found) != len(shape) or any(want not in (None, got) for want, got in zip(shape, found, strict=True)):
            raise InvalidFile(f"{path.name}: {name}", f"shape {shape}".replace("None", "any"), str(found))
        if arrays[name].dtype.kind not in "fiu" or not np.isfinite(arrays[name]).all():
            raise InvalidFile(f"{path.name}: {name}", "finite numbers", str(arrays[name].dtype))
    parents = arrays["kintree_table"][0].astype(np.int64)
    parents[0] = -1  # the file has 2^32 - 1 there
    if (parents[1:] >= np.arange(1, joints)).any() or (parents[1:] < 0).any():
        raise InvalidFile(f"{path.name}: kintree_table", "joints after their parents", str(parents.tolist()))
    faces = arrays["f"]
    if faces.dtype.kind == "f" or faces.min() < 0 or faces.max() >= vertices:
        found = f"{faces.dtype}, {faces.min():g} to {faces.max():g}"
        raise InvalidFile(f"{path.name}: f", f"whole indices in [0, {vertices})", found)
    floats = [arrays[name].astype(np.float64) for name in FIELDS[:5]]
    return Smpl(*floats, parents, faces.astype(np.int64))

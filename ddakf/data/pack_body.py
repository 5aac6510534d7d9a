"""Packs MakeHuman's body so that it may ship: ``python -m ddakf.data.pack_body FOLDER TARGET.npz [--triangles 11000]``.

The folder holds ``base.obj``, ``rig.game_engine.json``, ``weights.game_engine.json`` and a ``.target.gz``, all CC0. The body
is decimated with Open3D (extra ``evaluation``); its skinning weights are those of the nearest point of the original.
Fingers and toes move with hand and foot. The helper surface around the body, from which garments are cut, is kept whole.
"""

from __future__ import annotations

import argparse
import gzip
import json
from pathlib import Path

import numpy as np

from ddakf.body import proximity
from ddakf.data.body import INFLUENCES, POSITION_STEP, WEIGHT_STEPS, load_body
from ddakf.errors import DdakfError, InvalidFile
from ddakf.mesh import Mesh

BASE, RIG, WEIGHTS, SHAPE = "base.obj", "rig.game_engine.json", "weights.game_engine.json", "*.target.gz"
DECIMETRE = 0.1  # m, the unit of the base mesh
DROPPED_BONES = ("Root", "ball_l", "ball_r")  # fingers go as well
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
BODY, TIGHTS, GROUND = "body", "helper-tights", "joint-ground"


def pack_body(folder, target, triangles: int) -> int:
    """Writes the packed body.

    Args:
        folder: of the MakeHuman files.
        target: the ``.npz`` to write.
        triangles: of the decimated body.

    Returns:
        The number of its vertices.

    Raises:
        InvalidFile: a file that is not there.
    """
    folder = Path(folder)
    for pattern in (BASE, RIG, WEIGHTS, SHAPE):
        if not any(folder.glob(pattern)):
            raise InvalidFile(str(folder), f"MakeHuman's {pattern}", "none")
    vertices, groups = _read_groups(folder / BASE)
    _add_target(vertices, next(folder.glob(SHAPE)))
    vertices *= DECIMETRE
    vertices -= [0.0, vertices[np.unique(groups[GROUND])].mean(axis=0)[1], 0.0]
    names, parents, heads, of_bone = _skeleton(json.loads((folder / RIG).read_text()), vertices, groups)
    weights = _dense_weights(json.loads((folder / WEIGHTS).read_text())["weights"], of_bone, len(vertices))

    original, kept = _part(vertices, groups[BODY])
    body = _decimated(original, triangles)
    body_weights = _nearest_weights(original, weights[kept][:, : len(names)], body.vertices)
    tights, kept = _part(vertices, groups[TIGHTS])
    arrays = {
        "joint_names": np.array(names),
        "joint_parents": np.array(parents, np.int8),
        "joint_heads": heads.astype(np.float32),
    }
    for name, mesh, dense in (("body", body, body_weights), ("tights", tights, weights[kept])):
        arrays[f"{name}_vertices"] = np.rint(mesh.vertices / POSITION_STEP).astype(np.int16)
        arrays[f"{name}_faces"] = mesh.faces.astype(np.uint16)
        arrays[f"{name}_joints"], arrays[f"{name}_weights"] = _strongest(dense)
    np.savez_compressed(target, **arrays)
    return len(load_body(target).vertices)


def _read_groups(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Vertices (N, 3) and the triangles of every group of faces; quadrangles are split along the shorter diagonal later."""
    vertices, polygons, group = [], {}, ""
    for line in path.read_text().splitlines():
        key, *words = line.split() or [""]
        if key == "v":
            vertices.append([float(word) for word in words])
        elif key == "g":
            group = words[0]
        elif key == "f":
            polygons.setdefault(group, []).append([int(word.split("/")[0]) - 1 for word in words])
    vertices = np.array(vertices)
    return vertices, {name: np.concatenate([_split(vertices, polygon) for polygon in found]) for name, found in polygons.items()}


def _split(vertices: np.ndarray, polygon: list[int]) -> np.ndarray:
    """A triangle as it is; a quadrangle as two triangles, along the shorter diagonal."""
    if len(polygon) == 3:
        return np.array([polygon])
    a, b, c, d = polygon
    if np.linalg.norm(vertices[a] - vertices[c]) <= np.linalg.norm(vertices[b] - vertices[d]):
        return np.array([[a, b, c], [a, c, d]])
    return np.array([[a, b, d], [b, c, d]])


def _add_target(vertices: np.ndarray, path: Path) -> None:
    """Adds the offsets of a shape target, lines of index and three numbers."""
    rows = [line.split() for line in gzip.decompress(path.read_bytes()).decode().splitlines() if line[:1].isdigit()]
    vertices[[int(row[0]) for row in rows]] += np.array([[float(number) for number in row[1:]] for row in rows])


def _skeleton(rig: dict, vertices: np.ndarray, groups: dict[str, np.ndarray]):
    """Names, parents (-1 first) and heads (J, 3) of the bones that are kept, parents before children, and for every bone of
    the rig the index of the one that it moves with."""

    def dropped(bone: str) -> bool:
        return bone in DROPPED_BONES or bone.startswith(FINGERS)

    names = ["pelvis"]
    for name in names:
        names.extend(bone for bone, data in rig.items() if data["parent"] == name and not dropped(bone))
    of_bone = {name: index for index, name in enumerate(names)}
    parents = [of_bone.get(rig[name]["parent"], -1) for name in names]
    heads = np.array([vertices[np.unique(groups[rig[name]["head"]["cube_name"]])].mean(axis=0) for name in names])
    for bone in rig:
        carrier = bone
        while carrier and dropped(carrier):
            carrier = rig[carrier]["parent"]
        of_bone[bone] = of_bone[carrier or "pelvis"]
    return names, parents, heads, of_bone


def _dense_weights(weights: dict, of_bone: dict[str, int], n_vertices: int) -> np.ndarray:
    """(N, J) weights that sum to one."""
    dense = np.zeros((n_vertices, max(of_bone.values()) + 1))
    for bone, pairs in weights.items():
        for vertex, weight in pairs:
            dense[int(vertex), of_bone[bone]] += weight
    dense[dense.sum(axis=1) == 0, 0] = 1.0
    return dense / dense.sum(axis=1, keepdims=True)


def _part(vertices: np.ndarray, faces: np.ndarray) -> tuple[Mesh, np.ndarray]:
    kept, flat = np.unique(faces, return_inverse=True)
    return Mesh(vertices[kept], flat.reshape(-1, 3)), kept


def _decimated(mesh: Mesh, triangles: int) -> Mesh:
    import open3d

    vertices = open3d.utility.Vector3dVector(mesh.vertices.copy())
    faces = open3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    small = open3d.geometry.TriangleMesh(vertices, faces).simplify_quadric_decimation(triangles)
    return Mesh.cleaned(np.asarray(small.vertices), np.asarray(small.triangles))[0]


def _nearest_weights(original: Mesh, weights: np.ndarray, points: np.ndarray) -> np.ndarray:
    tree = proximity.build(original)
    found = proximity.closest_points(tree, proximity.refresh(tree, original.vertices), points, radius=np.inf)
    return np.einsum("nc,ncj->nj", found.barycentric, weights[tree.faces[found.face]])


def _strongest(dense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints (V, 4) uint8 and weights (V, 4) uint8 that sum to 255."""
    joints = np.argsort(-dense, axis=1, kind="stable")[:, :INFLUENCES]
    weights = np.take_along_axis(dense, joints, axis=1)
    weights = np.rint(WEIGHT_STEPS * weights / weights.sum(axis=1, keepdims=True)).astype(int)
    weights[:, 0] += WEIGHT_STEPS - weights.sum(axis=1)
    return joints.astype(np.uint8), weights.astype(np.uint8)


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder")
    parser.add_argument("target")
    parser.add_argument("--triangles", type=int, default=11_000)
    arguments = parser.parse_args(words)
    try:
        vertices = pack_body(arguments.folder, arguments.target, arguments.triangles)
    except DdakfError as refused:
        parser.error(str(refused))
    print(f"{arguments.target}: {vertices} vertices, {Path(arguments.target).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()

"""Track your own garment: read it, repair it, map the results back to the file's vertices.

python examples/05_your_own_mesh.py [GARMENT.obj|.ply]

Without a file it exports the bundled sample with typical defects.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import ddakf
from ddakf import data
from ddakf.evaluation.sensors import sample_surface
from ddakf.files.io import read_mesh


def write_export(path: Path) -> None:
    """Writes an .obj with typical defects: unused vertices, a duplicate face, a face without area."""
    sequence = data.sample()
    vertices = np.concatenate([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], sequence.template])
    faces = sequence.garment_faces + 2
    faces = np.concatenate([faces, faces[:1], [[5, 5, 6]]])
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")


def main(path: Path) -> None:
    vertices, faces = read_mesh(path)  # metres, y up; (V, 3) and (F, 3)
    try:
        garment, vertex_map = ddakf.Mesh(vertices, faces), np.arange(len(vertices))
    except ddakf.DdakfError as error:
        print(error)
        garment, vertex_map = ddakf.Mesh.cleaned(vertices, faces)
    print(f"{len(vertices)} vertices in the file, {garment.n_vertices} in the garment")

    # A cloud to track: the garment, half a metre aside. The tracker searches for it in the first frame.
    rng = np.random.default_rng(1)
    where = np.array([0.5, 0.0, 0.1])
    tracker = ddakf.Tracker(garment, config=ddakf.Config().with_fabric(ddakf.Fabric.JERSEY))
    for frame in range(6):
        cloud = sample_surface(garment.vertices + where, garment.faces, 8_000, rng) + rng.normal(0, 0.003, (8_000, 3))
        result = tracker.step(cloud, timestamp=frame / 30)

    # Vertex i of the result is vertex vertex_map[i] of the file. To draw results use garment.faces: the file's vertices that
    # the repair has joined or removed stay where they were.
    moved = vertices.copy()
    moved[vertex_map] = result.vertices
    print(f"{result.state}, moved by {np.median(result.vertices - garment.vertices, axis=0).round(3)} m (truth {where})")
    print(f"{(moved != vertices).any(axis=1).sum()} of the file's vertices have a new place")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            write_export(Path(folder) / "export.obj")
            main(Path(folder) / "export.obj")

"""Small meshes for the tests of the energies and of the body, and the energy of a linearization."""

import numpy as np

from ddakf.mesh import Mesh


def sheet(rows=5, columns=4, spacing=0.02, height=0.008) -> Mesh:
    """A wavy sheet, irregular enough that no term vanishes by symmetry."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2) * spacing
    wave = height * np.sin(90.0 * grid[:, 0]) * np.cos(70.0 * grid[:, 1])
    vertices = np.column_stack([grid, wave]) + rng.normal(scale=0.1 * spacing, size=(len(grid), 3))
    return Mesh(vertices, grid_faces(rows, columns))


def grid_faces(rows, columns) -> np.ndarray:
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + columns, corner + 1], axis=1)
    return np.concatenate([lower, np.stack([corner + 1, corner + columns, corner + columns + 1], axis=1)])


def ball(subdivisions=2, radius=0.2) -> Mesh:
    """An octahedron, subdivided and pushed out to a sphere; counter-clockwise seen from outside."""
    vertices = [np.array(v, float) for v in [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    for _ in range(subdivisions):
        middle, finer = {}, []
        for face in faces:
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                if (min(a, b), max(a, b)) not in middle:
                    middle[min(a, b), max(a, b)] = len(vertices)
                    vertices.append((vertices[a] + vertices[b]) / np.linalg.norm(vertices[a] + vertices[b]))
            i, j, k = face
            ij, jk, ki = (middle[min(a, b), max(a, b)] for a, b in [(i, j), (j, k), (k, i)])
            finer += [(i, ij, ki), (ij, j, jk), (ki, jk, k), (ij, jk, ki)]
        faces = finer
    return Mesh(radius * np.array(vertices), np.array(faces))


def rotation(seed: int) -> np.ndarray:
    """(3, 3) a random rotation."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.linalg.det(q)


def energy(linearization) -> float:
    """E = 1/2 sum w r^2, for unit stiffness."""
    return 0.5 * float(linearization.residual @ (linearization.weight * linearization.residual))

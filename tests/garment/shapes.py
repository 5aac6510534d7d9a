"""Other triangulations of a surface, and surfaces of simple shapes."""

import numpy as np

from ddakf import Mesh


def centre_split(mesh: Mesh, seed: int = 0) -> Mesh:
    """Half of the faces split at their centre: uneven triangles on the same surface; the first vertices are the mesh's."""
    rows = np.random.default_rng(seed).permutation(mesh.n_faces)[: mesh.n_faces // 2]
    (a, b, c), centre = mesh.faces[rows].T, mesh.n_vertices + np.arange(len(rows))
    parts = [np.stack(corners, axis=1) for corners in ((a, b, centre), (b, c, centre), (c, a, centre))]
    vertices = np.concatenate([mesh.vertices, mesh.vertices[mesh.faces[rows]].mean(axis=1)])
    return Mesh(vertices, np.concatenate([np.delete(mesh.faces, rows, axis=0), *parts]))


def turned_numbers(mesh: Mesh) -> Mesh:
    """The mesh with its vertices and faces in another order."""
    rng = np.random.default_rng(1)
    order = rng.permutation(mesh.n_vertices)
    return Mesh(mesh.vertices[order], np.argsort(order)[mesh.faces][rng.permutation(mesh.n_faces)])


def sheet(n: int = 24, size: float = 0.6) -> Mesh:
    """A square of n by n vertices, of ``size`` metres."""
    i, j = np.divmod(np.arange(n * n), n)
    first = np.flatnonzero((i < n - 1) & (j < n - 1))
    faces = np.concatenate([np.stack([first, first + n, first + 1], 1), np.stack([first + 1, first + n, first + n + 1], 1)])
    return Mesh(np.stack([size * i / (n - 1), size * j / (n - 1), np.zeros(n * n)], axis=1), faces)


def turned_about_y(profile: np.ndarray, around: int = 24) -> Mesh:
    """The closed surface of a line of (radius, height) points from one pole to the other, which are its ends' heights."""
    radius, height = profile[1:-1].T
    angle = 2 * np.pi * np.arange(around) / around
    x, y, z = np.outer(radius, np.cos(angle)), np.repeat(height[:, None], around, axis=1), np.outer(radius, np.sin(angle))
    rings = np.stack([x, y, z], axis=-1)
    poles = [[0.0, profile[0, 1], 0.0], [0.0, profile[-1, 1], 0.0]]
    a, b = np.arange(around), (np.arange(around) + 1) % around
    lower = around * np.arange(len(radius) - 1)[:, None]
    quads = [(lower + a, lower + around + a, lower + b), (lower + b, lower + around + a, lower + around + b)]
    n, top = rings.size // 3, around * (len(radius) - 1)
    faces = [np.stack([*map(np.ravel, corners)], axis=1) for corners in quads]
    faces += [np.stack([np.full(around, n), a, b], axis=1), np.stack([top + b, top + a, np.full(around, n + 1)], axis=1)]
    return Mesh(np.concatenate([rings.reshape(-1, 3), poles]), np.concatenate(faces))


def sieve(n: int, cell: float, every: int) -> Mesh:
    """A closed slab of n by n by 2 vertices, ``cell`` metres apart, with a square hole through it in every so-many-th cell."""
    i, j = np.divmod(np.arange(n * n), n)
    lower = np.stack([cell * i, cell * j, np.zeros(n * n)], axis=1)
    cells = np.flatnonzero((i < n - 1) & (j < n - 1))
    a, b = np.divmod(cells, n)
    open_ = (a % every == 1) & (b % every == 1) & (a < n - 2) & (b < n - 2)
    around = np.stack([cells, cells + n, cells + n + 1, cells + 1], axis=1)
    flat, holes = around[~open_], around[open_]
    walls = [np.stack([y, x, x + n * n, y + n * n], axis=1) for x, y in zip(holes.T, np.roll(holes, -1, axis=1).T, strict=True)]
    k = np.arange(n - 1)
    rims = ((n * k, n * (k + 1)), (n * (k + 1) + n - 1, n * k + n - 1), (k + 1, k), (n * (n - 1) + k, n * (n - 1) + k + 1))
    walls += [np.stack([x, y, y + n * n, x + n * n], axis=1) for x, y in rims]
    quads = np.concatenate([flat[:, ::-1], flat + n * n, *walls])
    return Mesh(np.concatenate([lower, lower + [0, 0, cell]]), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))

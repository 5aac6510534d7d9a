"""A body that bends, and a loose tube of cloth around it: small, closed, and with known answers."""

import numpy as np

from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh


def tube(radius, height, rings, around, closed=False, raised=0.0):
    """A vertical tube, normals outward; ``closed`` with a lid on either end, ``raised`` above the ground."""
    angle, level = np.arange(around) * 2 * np.pi / around, np.linspace(0, height, rings)
    a, y = np.meshgrid(angle, level)
    vertices = np.stack([radius * np.cos(a), y, radius * np.sin(a)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    p, q = (i * around + j).ravel(), (i * around + (j + 1) % around).ravel()
    faces = np.concatenate([np.stack([p, p + around, q], 1), np.stack([q, p + around, q + around], 1)])
    if closed:
        ends, n = [[0, 0, 0], [0, height, 0]], len(vertices)
        ring, after = np.arange(around), (np.arange(around) + 1) % around
        top = (rings - 1) * around
        lids = [np.stack([ring, after, np.full(around, n)], 1), np.stack([after + top, ring + top, np.full(around, n + 1)], 1)]
        vertices, faces = np.concatenate([vertices, ends]), np.concatenate([faces, *lids])
    return Mesh(vertices + [0, raised, 0], faces)


def uneven(mesh, seed):
    """Moved by a millimetre at random, so that no two distances are equal."""
    return Mesh(mesh.vertices + 1e-3 * np.random.default_rng(seed).normal(size=mesh.vertices.shape), mesh.faces)


BODY, GARMENT = uneven(tube(0.12, 0.8, 17, 20, closed=True), 0), uneven(tube(0.14, 0.5, 11, 18, raised=0.15), 1)


def turn(angle, axis="y"):
    c, s = np.cos(angle), np.sin(angle)
    return {"y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]])}[axis]


def bent(vertices, angle):
    """Leaning over, the more the higher up: the whole by ``angle`` at 0.8 m, radians."""
    lean = angle * vertices[:, 1] / 0.8
    c, s = np.cos(lean), np.sin(lean)
    x, y, z = vertices.T
    return np.stack([x * c + y * s, y * c - x * s, z], axis=1)


def swaying(frames=40, lag=0.0, name="tube_sway"):
    """The body leans to and fro; the cloth with it, so many seconds behind, and sags by a centimetre to the rear."""
    time = np.arange(frames) / 30
    angle, late = 0.4 * np.sin(4 * time), 0.4 * np.sin(4 * np.maximum(time - lag, 0))
    body = np.array([bent(BODY.vertices, a) for a in angle])
    cloth = np.array([bent(GARMENT.vertices, a) for a in late]) + 0.01 * np.abs(angle)[:, None, None] * [0, -1, 0]
    return Sequence(name, cloth.astype(np.float32), GARMENT.faces, 30.0, None, body.astype(np.float32), BODY.faces)

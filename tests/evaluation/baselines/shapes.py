"""Small garments for the tests of baselines."""

import numpy as np

from ddakf.mesh import Mesh


def tube(around=24, along=14):
    """An open tube with an oval section of 40 x 25 cm, 60 cm high, with bumps that tell its sides apart."""
    angle, height = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.linspace(0, 0.6, along + 1), indexing="ij")
    swell = 1 + 0.15 * np.cos(3 * angle) * np.sin(5 * height)
    vertices = np.stack([0.2 * swell * np.cos(angle), height, -0.125 * swell * np.sin(angle)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(along), indexing="ij")
    a, b = i * (along + 1) + j, (i + 1) % around * (along + 1) + j
    faces = np.stack([np.stack([a, b, b + 1], axis=-1), np.stack([a, b + 1, a + 1], axis=-1)]).reshape(-1, 3)
    return Mesh(vertices, faces)


def moved(vertices, angle, shift):
    """Turned about the vertical, then shifted."""
    c, s = np.cos(angle), np.sin(angle)
    return vertices @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + shift


def widened(vertices, amount):
    """A wider and flatter section: x longer and z shorter by a share ``amount``."""
    return vertices * [1 + amount, 1, 1 - amount]

"""Openings that run beside another part of the garment."""

import numpy as np
import pytest

from ddakf import Mesh
from ddakf.garment import seams
from tests.tracker_runs import SHIRT, TUBE


def in_two(mesh: Mesh, apart: float) -> Mesh:
    """The mesh cut at half its height, the upper part ``apart`` metres higher."""
    upper = mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > mesh.vertices[:, 1].mean()
    vertices = np.concatenate([mesh.vertices + [0.0, apart, 0.0], mesh.vertices])
    faces = np.concatenate([mesh.faces[upper], mesh.faces[~upper] + mesh.n_vertices])
    used, numbers = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], numbers.reshape(faces.shape))


@pytest.mark.parametrize("apart", [0.002, 0.005, 0.01])
def test_the_gap_is_how_far_the_parts_are_apart(apart):
    for mesh in (TUBE, SHIRT):
        assert seams.gap(in_two(mesh, apart)) == pytest.approx(apart, rel=0.2)


def test_parts_that_are_far_apart_are_no_open_seam():
    assert seams.gap(in_two(TUBE, 0.1)) == 0.0


@pytest.mark.parametrize("mesh", [SHIRT, TUBE], ids=["shirt", "tube"])
def test_a_garment_of_one_piece_has_none(mesh):
    assert seams.gap(mesh) == 0.0


def test_panels_that_lie_beside_each_other_along_a_part_of_their_outline_are_apart():
    """Hems belong to no seam: half of a panel's outline is beside the other one."""
    front = TUBE.vertices[TUBE.faces].mean(axis=1)[:, 2] > TUBE.vertices[:, 2].mean()
    vertices = np.concatenate([TUBE.vertices, TUBE.vertices + [0.0, 0.0, 0.003]])
    faces = np.concatenate([TUBE.faces[~front], TUBE.faces[front] + TUBE.n_vertices])
    used, numbers = np.unique(faces, return_inverse=True)
    assert seams.gap(Mesh(vertices[used], numbers.reshape(faces.shape))) == pytest.approx(0.003, rel=0.1)


def test_openings_that_cross_far_from_each_other_are_none():
    """As a skirt and a shirt whose hem is twice as wide: they come near in places alone."""
    wide = TUBE.vertices * [2.0, 1.0, 1.0] + [0.0, np.ptp(TUBE.vertices[:, 1]), 0.0]
    both = Mesh(np.concatenate([TUBE.vertices, wide]), np.concatenate([TUBE.faces, TUBE.faces + TUBE.n_vertices]))
    assert seams.gap(both) == 0.0

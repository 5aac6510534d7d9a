"""Rehearsed cloth hangs on the body, keeps its lengths, and is reproducible."""

import numpy as np
import pytest

from ddakf.evaluation.baselines.clothfit import rehearsal
from ddakf.evaluation.baselines.clothfit.rehearsal import Rehearsal, colours, hinge_tips, rehearsals, rehearse
from ddakf.evaluation.metrics import Penetration
from ddakf.mesh import Mesh

pytestmark = pytest.mark.slow

SQUARE = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))


def test_hinges_are_bridged_from_tip_to_tip():
    assert np.sort(hinge_tips(SQUARE)).tolist() == [[1, 3]]


def test_pairs_of_a_colour_share_nothing():
    pairs = np.random.default_rng(0).permuted(np.tile(np.arange(12), (60, 1)), axis=1)[:, :2]
    colour = colours(pairs, 12)
    for k in range(colour.max() + 1):
        together = pairs[colour == k].ravel()
        assert len(set(together)) == len(together)
    assert colours(np.array([[0, 1], [2, 3], [1, 2]]), 4).tolist() == [0, 0, 1]


def test_every_garment_has_every_motion_once():
    assert len({part[:2] for part in rehearsals()}) == len(rehearsals()) == 28


@pytest.fixture(scope="module")
def short():
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("FRAMES", 20), ("SETTLING", 10), ("VERTICES", 250)):
            patch.setattr(rehearsal, name, value)
        yield rehearse([Rehearsal("tshirt", "dance", 0, 3), Rehearsal("skirt", "walk", 0, 4)])


def test_cloth_keeps_its_lengths_and_stays_outside(short):
    for sequence in short:
        assert len(sequence) == 20
        mesh = Mesh(sequence.template, sequence.garment_faces)
        ends = sequence.garment_vertices[:, mesh.edges]
        stretch = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
        stretch /= np.linalg.norm(mesh.vertices[mesh.edges[:, 0]] - mesh.vertices[mesh.edges[:, 1]], axis=1)
        assert np.abs(stretch - 1).mean() < 0.03
        inside = Penetration(Mesh(sequence.body_vertices[0], sequence.body_faces))
        assert inside(sequence.garment_vertices[-1].astype(float), sequence.body_vertices[-1])[0] < 1


def test_the_skirts_waistband_goes_with_the_body_and_its_hem_swings(short):
    skirt = short[1]
    height = skirt.template[:, 1]
    body = skirt.body_vertices.mean(axis=1)
    moved = (skirt.garment_vertices - skirt.garment_vertices[0]) - (body - body[0])[:, None]
    speed = np.linalg.norm(np.diff(moved, axis=0), axis=2).mean(axis=0)
    order = np.argsort(height)
    assert speed[order[:25]].mean() > speed[order[-8:]].mean()
    assert skirt.garment_vertices[:, :, 1].min() > 0.1


def test_it_does_not_fall_off(short):
    assert all(abs(s.garment_vertices[-1, :, 1].mean() - s.template[:, 1].mean()) < 0.1 for s in short)

"""Surfaces whose Hausdorff distance is known, and real ones against dense sampling."""

import numpy as np
import pytest

from ddakf.data import sample
from ddakf.evaluation import metrics
from ddakf.mesh import Mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
WITHIN = 0.0101  # mm: the tolerance, and rounding


def test_of_a_square_by_hand():
    hausdorff = metrics.Hausdorff(Mesh(SQUARE, FACES))
    assert hausdorff(SQUARE, SQUARE) == 0
    assert hausdorff(SQUARE + [0, 0, 0.05], SQUARE) == pytest.approx(50)
    assert hausdorff(SQUARE + [0.3, 0.4, 0], SQUARE) == pytest.approx(500, abs=WITHIN), "a corner sticks out"
    lifted = SQUARE + [[0, 0, 0.1], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert hausdorff(lifted, SQUARE) == pytest.approx(100), "the corner above its own place"


def test_is_the_larger_of_both_directions():
    half = metrics.Hausdorff(Mesh(SQUARE * [0.5, 1, 1], FACES), Mesh(SQUARE, FACES))
    assert half(SQUARE * [0.5, 1, 1], SQUARE) == pytest.approx(500), "the half lies in the whole, but not the whole in the half"
    whole = metrics.Hausdorff(Mesh(SQUARE, FACES), Mesh(SQUARE * [0.5, 1, 1], FACES))
    assert whole(SQUARE, SQUARE * [0.5, 1, 1]) == pytest.approx(500)


def test_finds_the_middle_of_a_face():
    """A lid over two slopes, whose corners touch them; nothing is below its middle."""
    rims = np.array([[0, 0, 0], [0, 1, 0], [0.1, 0, -0.1], [0.1, 1, -0.1], [1, 0, 0], [1, 1, 0], [0.9, 0, -0.1], [0.9, 1, -0.1]])
    faces = np.array([[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6]])
    slopes = Mesh(rims, faces)
    at_vertices = np.concatenate([
        metrics.SurfaceDistance(slopes)(SQUARE, rims), metrics.SurfaceDistance(Mesh(SQUARE, FACES))(rims, SQUARE),
    ])  # fmt: skip
    assert at_vertices.max() == pytest.approx(0.1), "the lower rims below the lid"
    # the lid's middle line is sqrt(0.4^2 + 0.1^2) from the lower rims
    hausdorff = metrics.Hausdorff(Mesh(SQUARE, FACES), slopes)
    assert hausdorff(SQUARE, rims) == pytest.approx(1e3 * np.hypot(0.4, 0.1), abs=WITHIN)


def test_agrees_with_dense_sampling():
    sequence = sample()
    mesh = Mesh(sequence.garment_rest, sequence.garment_faces)
    truth = sequence.garment_vertices[70].astype(float)
    grid = [(i / 6, j / 6) for i in range(7) for j in range(7 - i)]
    distance, hausdorff = metrics.SurfaceDistance(mesh), metrics.Hausdorff(mesh)
    for other in (sequence.garment_vertices[71].astype(float), truth + 0.003 * np.random.default_rng(0).normal(size=truth.shape)):
        sampled = 0.0
        for one, surface in ((truth, other), (other, truth)):
            a, b, c = (one[mesh.faces[:, k]] for k in range(3))
            points = np.concatenate([a + (b - a) * v + (c - a) * w for v, w in grid])
            sampled = max(sampled, 1e3 * distance(points, surface).max())
        exact = hausdorff(other, truth)
        assert sampled - WITHIN <= exact <= sampled + 1, "samples are at most a millimetre or so from the worst point"
        assert hausdorff(truth, other) == pytest.approx(exact, abs=WITHIN)
        assert exact <= 1e3 * np.linalg.norm(other - truth, axis=1).max() + WITHIN, "no more than the farthest counterparts"


def test_of_a_torn_estimate_is_the_same_from_either_side():
    """What is left out of the search in the second direction is what the first has found."""
    rng = np.random.default_rng(1)
    sequence = sample()
    truth = sequence.garment_vertices[70].astype(float)
    hausdorff = metrics.Hausdorff(Mesh(sequence.garment_rest, sequence.garment_faces))
    some = rng.random((len(truth), 1)) < 0.01
    for torn in (np.where(some, rng.permutation(truth), truth), truth + 0.3 * some * rng.normal(size=truth.shape)):
        assert hausdorff(torn, truth) > 50
        assert hausdorff(torn, truth) == pytest.approx(hausdorff(truth, torn), abs=WITHIN)


def test_turns_with_the_surfaces():
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    bent = SQUARE + 0.2 * rng.normal(size=SQUARE.shape)
    hausdorff = metrics.Hausdorff(Mesh(SQUARE, FACES))
    assert hausdorff(bent @ turn + 3, SQUARE @ turn + 3) == pytest.approx(hausdorff(bent, SQUARE), abs=2 * WITHIN)


def test_of_no_surface_is_no_number():
    broken = SQUARE.copy()
    broken[2, 1] = np.nan
    assert np.isnan(metrics.Hausdorff(Mesh(SQUARE, FACES))(broken, SQUARE))

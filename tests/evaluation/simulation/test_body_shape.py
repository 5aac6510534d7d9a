"""Shapes of the body change the measures that they name, keep the surface sound, and travel as eight numbers."""

import itertools

import numpy as np
import pytest

from ddakf.data.body import load_body
from ddakf.data.body_shape import PLAIN, RANGES, BodyShape, random_shape, shaped
from ddakf.errors import InvalidArgument


@pytest.fixture(scope="module")
def body():
    return load_body()


def length(body, *joints):
    places = [body.head(joint) for joint in joints]
    return sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(places))


def volume(body):
    a, b, c = body.vertices[body.faces].transpose(1, 0, 2)
    return np.einsum("fa,fa->", a, np.cross(b, c)) / 6


def test_the_plain_shape_is_the_body_that_ships(body):
    assert shaped(body, PLAIN) is body
    assert random_shape(0) == PLAIN


@pytest.mark.parametrize(
    ("field", "joints"),
    [
        ("legs", ("thigh_l", "calf_l", "foot_l")),
        ("arms", ("upperarm_r", "lowerarm_r", "hand_r")),
        ("hips", ("thigh_l", "thigh_r")),
        ("shoulders", ("clavicle_l", "clavicle_r")),
    ],
)
def test_a_factor_changes_its_own_measure_by_as_much(body, field, joints):
    other = shaped(body, BodyShape(**{field: 1.1}))
    assert length(other, *joints) / length(body, *joints) == pytest.approx(1.1, abs=0.01)


def test_stature_scales_everything_and_keeps_the_soles(body):
    tall = shaped(body, BodyShape(stature=1.1))
    assert volume(tall) / volume(body) == pytest.approx(1.1**3, rel=1e-6)
    assert tall.vertices[:, 1].min() == pytest.approx(body.vertices[:, 1].min(), abs=1e-12)


def test_girth_changes_volume_but_no_bone(body):
    wide = shaped(body, BodyShape(limbs=1.15, hips=1.15, depth=1.15))
    assert volume(wide) > 1.1 * volume(body)
    assert length(wide, "thigh_l", "calf_l") == pytest.approx(length(body, "thigh_l", "calf_l"), rel=1e-6)


@pytest.mark.parametrize("seed", range(1, 9))
def test_random_shapes_are_within_their_ranges_and_turn_no_face_over(body, seed):
    shape = random_shape(seed)
    assert all(low <= getattr(shape, field) <= high for field, (low, high) in RANGES.items())
    other = shaped(body, shape)
    a, b, c = (np.stack([of.vertices[of.faces] for of in (body, other)])[:, :, corner] for corner in range(3))
    before, after = np.cross(b - a, c - a)
    assert ((before * after).sum(axis=1) > 0).mean() > 0.999
    left, right = other.vertices[:, 0].max(), -other.vertices[:, 0].min()
    assert left == pytest.approx(right, rel=0.01)


def test_a_shape_is_restored_from_its_numbers_exactly():
    shape = random_shape(5)
    assert BodyShape.from_array(shape.to_array()) == shape
    assert random_shape(5) == shape != random_shape(6)


@pytest.mark.parametrize("numbers", [np.ones(7), np.full(8, 3.0), np.zeros(8)])
def test_numbers_that_are_no_shape_are_refused(numbers):
    with pytest.raises(InvalidArgument, match="body_shape"):
        BodyShape.from_array(numbers)

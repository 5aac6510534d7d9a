"""One network for all vertices, whose answer turns and is mirrored with its inputs."""

from itertools import pairwise

import numpy as np
import pytest

from ddakf.evaluation.baselines.clothfit.inputs import LENGTH, SCALARS, STILL, VECTORS, Inputs
from ddakf.evaluation.baselines.clothfit.network import INPUTS, OUTPUTS, Committee, Network, basis, invariants
from ddakf.evaluation.baselines.clothfit.settings import AnswerSettings
from tests.evaluation.baselines.clothfit.scene import turn

SETTINGS = AnswerSettings(gate=1.0, caution=2.0, smoothing=0)
MIRROR = np.diag([1.0, 1.0, -1.0])


def random_network(seed=0):
    rng = np.random.default_rng(seed)
    sizes = (INPUTS, 8, 8, OUTPUTS)
    layers = tuple(
        (rng.normal(size=(a, b)).astype(np.float32) / a**0.5, rng.normal(size=b).astype(np.float32))
        for a, b in pairwise(sizes)
    )
    return Network(rng.normal(size=INPUTS).astype(np.float32), np.ones(INPUTS, np.float32), layers)


def some_inputs(seed=1, count=7):
    rng = np.random.default_rng(seed)
    vectors, scalars = rng.normal(size=(count, len(VECTORS), 3)), rng.normal(size=(count, len(SCALARS)))
    return Inputs(np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)), vectors, scalars)


def committee(count=3):
    return Committee(tuple(random_network(seed) for seed in range(count)))


def test_a_zero_network_adds_nothing():
    assert not Committee((Network.zero(),)).offsets(some_inputs(), SETTINGS).any()


@pytest.mark.parametrize("by", [turn(0.9) @ turn(0.4, "x"), MIRROR])
def test_the_offset_turns_and_is_mirrored_with_the_vectors(by):
    inputs = some_inputs()
    other = inputs._replace(vectors=inputs.vectors @ by.T)
    assert committee().offsets(other, SETTINGS) == pytest.approx(committee().offsets(inputs, SETTINGS) @ by.T, abs=1e-4)
    assert np.abs(committee().offsets(inputs, SETTINGS)).max() > 1e-3


def test_vertices_are_answered_one_by_one():
    inputs = some_inputs()
    part = Inputs(*(array[2:4] for array in inputs))
    assert committee().offsets(inputs, SETTINGS)[2:4] == pytest.approx(committee().offsets(part, SETTINGS), abs=1e-6)


def test_without_change_since_the_start_there_is_no_offset():
    inputs = some_inputs()
    inputs.vectors[:, len(STILL) :] = 0
    assert not committee().offsets(inputs, SETTINGS).any()
    assert not basis(inputs.vectors, 1.0).any()
    assert not basis(inputs.vectors, 0.0).any()
    inputs.vectors[:, -1] = [2.0, 1.0, 2.0]
    still = inputs.vectors[:, : len(STILL)]
    for gate, share in ((0.0, 1.0), (1.0, 0.75), (3.0, 0.5)):
        assert basis(inputs.vectors, gate)[:, : len(STILL)] == pytest.approx(share * still)


def test_invariants_are_the_inner_products_and_the_scalars():
    vectors, scalars = some_inputs().vectors, some_inputs().scalars
    seen = invariants(vectors, scalars)
    assert seen.shape == (7, INPUTS)
    assert seen[0, 1] == pytest.approx(np.arcsinh(vectors[0, 0] @ vectors[0, 1]), rel=1e-5)
    assert seen[:, -len(SCALARS) :] == pytest.approx(scalars)


def test_inputs_far_from_all_that_was_learned_from_count_as_the_limit():
    network, inputs = random_network(), np.zeros((1, INPUTS), np.float32)
    far, farther = inputs + 1e3, inputs + 1e9
    assert network.coefficients(far) == pytest.approx(network.coefficients(farther))


def test_members_that_agree_are_believed_and_those_that_differ_less():
    inputs, one = some_inputs(), random_network()
    alone = Committee((one,)).offsets(inputs, SETTINGS)
    coefficients = one.coefficients(invariants(inputs.vectors, inputs.scalars))
    answer = np.einsum("qk,qka->qa", coefficients, basis(inputs.vectors, SETTINGS.gate))
    assert alone == pytest.approx(LENGTH * answer, abs=1e-6)
    assert Committee((one, one)).offsets(inputs, SETTINGS) == pytest.approx(alone, abs=1e-6)
    with_nothing = Committee((one, Network.zero())).offsets(inputs, SETTINGS)
    assert with_nothing == pytest.approx(alone / 2 / (1 + SETTINGS.caution), abs=1e-6)


def test_arrays_there_and_back():
    again = Committee.from_arrays(committee().arrays())
    assert np.array_equal(again.offsets(some_inputs(), SETTINGS), committee().offsets(some_inputs(), SETTINGS))

"""Training lowers the training error, and is reproducible."""

import numpy as np
import pytest

from ddakf.errors import NotApplicable
from ddakf.evaluation.baselines.clothfit import settings, training
from ddakf.evaluation.baselines.clothfit.examples import examples
from ddakf.evaluation.baselines.clothfit.network import Network, basis, invariants
from ddakf.evaluation.baselines.clothfit.settings import Stretches
from tests.evaluation.baselines.clothfit.scene import swaying

pytestmark = pytest.mark.slow

CUT = Stretches(count=2, frames=30, every=2, vertices=80, shortest=20)
TINY = settings.TrainingSettings(CUT, CUT, members=2, hidden=16, steps=150, tuning_steps=20, batch=256, rate=1e-2)


@pytest.fixture(scope="module")
def late():
    """A garment that is 0.1 s behind the body."""
    pytest.importorskip("torch")
    return examples(swaying(60, lag=0.1), CUT, seed=0)


def answered(network: Network, by) -> np.ndarray:
    return np.einsum("qk,qka->qa", network.coefficients(invariants(by.vectors, by.scalars)), basis(by.vectors, TINY.gate))


def error(network: Network, of) -> float:
    answer = answered(network, of)
    return float(np.sqrt(np.mean(np.sum((answer - of.offsets) ** 2, axis=1))))


def test_training_lowers_the_error(late):
    network, losses = training.fit([late], [], TINY, 0, lambda *_: None)
    assert len(losses) == TINY.steps
    assert np.mean(losses[-20:]) < 0.75 * np.mean(losses[:20])
    assert error(network, late) < 0.5 * error(Network.zero(), late)


def test_numpy_answers_as_torch_did(late):
    """The loss of the exported network, on the very last batch's recording, is that of the training's end."""
    network, losses = training.fit([late], [], TINY, 0, lambda *_: None)
    loss = np.sqrt(np.sum((answered(network, late) - late.offsets) ** 2, axis=1) + TINY.robust**2).mean()
    assert loss == pytest.approx(np.mean(losses[-20:]), rel=0.1)


def test_the_same_seed_gives_the_same_network(late):
    one, two = (training.fit([late], [late], TINY, 0, lambda *_: None)[0].arrays() for _ in range(2))
    assert all(np.array_equal(one[name], two[name]) for name in one)


def test_progress_counts_both_phases_of_all_members(late):
    seen = []
    training.committee([late], [late], TINY, lambda done, total, what: seen.append((done, total, what)))
    assert (seen[0], seen[169], seen[170]) == ((1, 340, "training"), (170, 340, "tuning"), (171, 340, "training"))
    assert seen[-1] == (340, 340, "tuning")


def test_each_member_does_without_its_share(monkeypatch):
    heard = []

    def fit(own, external, settings, seed, progress):
        heard.append((own, external, seed))
        return Network.zero(), []

    monkeypatch.setattr(training, "fit", fit)
    training.committee(["a", "b", "c"], ["d"], TINY, lambda *_: None)
    assert heard == [(["b"], ["d"], 0), (["a", "c"], ["d"], 1)]


def test_without_torch_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "torch", None)
    with pytest.raises(NotApplicable, match=r"torch is not installed: pip install 'ddakf\[learned\]'"):
        training.torch()

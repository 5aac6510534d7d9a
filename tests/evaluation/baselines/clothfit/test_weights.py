"""Weights are cached by code, settings and data, and load unchanged."""

import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from ddakf import data
from ddakf.errors import InvalidFile, NotApplicable
from ddakf.evaluation.baselines.clothfit import library, weights
from ddakf.evaluation.baselines.clothfit.library import Source
from ddakf.evaluation.baselines.clothfit.network import Committee
from ddakf.evaluation.baselines.clothfit.settings import Stretches, TrainingSettings
from ddakf.evaluation.splits import RecordingLabels
from ddakf.evaluation.trials.methods import make_baseline
from tests.evaluation.baselines.clothfit.scene import BODY, GARMENT, swaying
from tests.evaluation.baselines.clothfit.test_network import SETTINGS, committee, some_inputs

CUT = Stretches(count=1, frames=12, every=2, vertices=60, shortest=10)
TINY = TrainingSettings(CUT, CUT, members=2, hidden=8, steps=30, tuning_steps=10, batch=64)


@pytest.fixture
def two_sources(tmp_path, monkeypatch):
    """Two recordings of a tube, in a cache of their own."""
    found = []
    for name, lag in (("tube_one", 0.1), ("tube_two", 0.2)):
        s, path = swaying(20, lag), tmp_path / f"{name}.npz"
        body = {"body_V": s.body_vertices, "body_F": s.body_faces}
        np.savez(path, garment_V=s.garment_vertices, garment_F=s.garment_faces, fps=s.fps, **body)
        found.append(Source(RecordingLabels(name, name, name), path, name == "tube_two"))
    monkeypatch.setattr(library, "sources", lambda: found)
    monkeypatch.setenv("DDAKF_CACHE", str(tmp_path / "cache"))
    return found


def test_saved_weights_come_back_as_they_were(tmp_path):
    np.savez(tmp_path / "w.npz", **committee().arrays())
    with np.load(tmp_path / "w.npz", allow_pickle=False) as archive:
        again = Committee.from_arrays(dict(archive))
    assert np.array_equal(again.offsets(some_inputs(), SETTINGS), committee().offsets(some_inputs(), SETTINGS))


def test_weights_of_another_network_are_refused(tmp_path):
    arrays = committee().arrays()
    with pytest.raises(InvalidFile, match="weights of"):
        weights._checked(tmp_path / "w.npz", arrays | {"1.mean": arrays["1.mean"][1:]})


def test_the_key_tells_data_and_settings_apart(two_sources):
    keys = {weights.key(chosen, settings) for chosen in (two_sources, two_sources[:1]) for settings in (TINY, TrainingSettings())}
    assert len(keys) == 4
    before = weights.key(two_sources, TINY)
    two_sources[0].origin.write_bytes(two_sources[0].origin.read_bytes() + b"\0")
    assert weights.key(two_sources, TINY) != before


def test_what_is_scored_is_not_in_the_training(two_sources, monkeypatch):
    pytest.importorskip("torch")
    seen, train = [], weights.train

    def noted(chosen, *rest):
        seen.append([source.labels.name for source in chosen])
        return train(chosen, *rest)

    monkeypatch.setattr(weights, "train", noted)
    weights.committee(RecordingLabels("tube_two"), TINY)
    weights.committee(RecordingLabels("other", "", "tube_one"), TINY)
    assert seen == [["tube_one"], ["tube_two"]]


def test_it_trains_once_and_then_needs_no_torch(two_sources, monkeypatch, capsys):
    pytest.importorskip("torch")
    first = weights.committee(RecordingLabels("elsewhere"), TINY)
    out = capsys.readouterr()
    assert out.out == ""
    monkeypatch.setitem(sys.modules, "torch", None)
    again = weights.committee(RecordingLabels("elsewhere"), TINY)
    assert all(np.array_equal(first.arrays()[name], again.arrays()[name]) for name in first.arrays())
    assert first.members[0].layers[-1][0].any()


def test_sentences_where_it_cannot_be_used(two_sources, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(NotApplicable, match="torch is not installed"):
        make_baseline("clothfit").start(GARMENT, GARMENT.vertices, BODY)
    monkeypatch.setattr(library, "sources", lambda: [Source(RecordingLabels("sample"), data.SAMPLE)])
    with pytest.raises(NotApplicable, match="nothing to learn from once sample is left out"):
        make_baseline("clothfit", RecordingLabels("sample")).start(GARMENT, GARMENT.vertices, BODY)


def test_examples_are_made_once_for_all_that_leave_out_something_else(two_sources, monkeypatch):
    pytest.importorskip("torch")
    first = weights.committee(RecordingLabels("elsewhere"), TINY)
    kept = {path.name for path in weights.folder().iterdir()}
    assert len([name for name in kept if name.startswith("clothfit-examples-")]) == 2
    monkeypatch.setattr(weights, "examples", None)
    other = weights.committee(RecordingLabels("tube_two"), TINY)
    assert not all(np.array_equal(first.arrays()[name], other.arrays()[name]) for name in first.arrays())
    assert {path.name for path in weights.folder().iterdir()} > kept
    assert not [path for path in weights.folder().iterdir() if path.suffix == ".part"]


def test_what_nobody_used_for_a_month_goes_when_something_new_comes(two_sources):
    pytest.importorskip("torch")
    weights.committee(RecordingLabels("elsewhere"), TINY)
    old, known = time.time() - 31 * 86400, set(weights.folder().glob("clothfit-*"))
    for path in known:
        os.utime(path, (old, old))
    weights.committee(RecordingLabels("tube_two"), TINY)
    left = set(weights.folder().glob("clothfit-*"))
    assert len(known - left) == 2, "the other weights, and the examples of what they alone learned from"
    assert len(left - known) == 1


def test_weights_in_use_are_noted_as_such(two_sources, monkeypatch):
    pytest.importorskip("torch")
    weights.committee(RecordingLabels("elsewhere"), TINY)
    path = next(path for path in weights.folder().glob("clothfit-*.npz") if "examples" not in path.name)
    os.utime(path, (0, 0))
    weights.committee(RecordingLabels("elsewhere"), TINY)
    assert path.stat().st_mtime > time.time() - 3600


def test_two_that_need_the_same_weights_train_once(two_sources, monkeypatch):
    pytest.importorskip("torch")
    trained, train = [], weights.train
    monkeypatch.setattr(weights, "train", lambda *of: trained.append(1) or train(*of))
    with ThreadPoolExecutor(2) as pool:
        one, two = pool.map(lambda _: weights.committee(RecordingLabels("elsewhere"), TINY), range(2))
    assert len(trained) == 1
    assert np.array_equal(one.offsets(some_inputs(), SETTINGS), two.offsets(some_inputs(), SETTINGS))

"""The library excludes the scored recording, its garment and its motion from training."""

import numpy as np
import pytest

from ddakf import data
from ddakf.evaluation.baselines.clothfit.library import Source, sources, without_scored
from ddakf.evaluation.baselines.clothfit.rehearsal import Rehearsal
from ddakf.evaluation.splits import NO_LABELS, RecordingLabels

LABELS = (("a", "skirt", "jump"), ("b", "skirt", "dance"), ("c", "tank top", "jump"), ("d", "tank top", "walk"))
SOURCES = [Source(RecordingLabels(*labels), data.SAMPLE) for labels in LABELS]


def names(kept):
    return [source.labels.name for source in kept]


def test_name_garment_and_motion_are_left_out():
    assert names(without_scored(RecordingLabels("a", "skirt", "jump"), SOURCES)) == ["d"]
    assert names(without_scored(RecordingLabels("other", "", "jump"), SOURCES)) == ["b", "d"]
    assert names(without_scored(RecordingLabels("d"), SOURCES)) == ["a", "b", "c"]


def test_nothing_said_leaves_nothing_out():
    unnamed = Source(RecordingLabels("", "", ""), data.SAMPLE)
    assert names(without_scored(NO_LABELS, [*SOURCES, unnamed])) == ["a", "b", "c", "d", ""]


@pytest.mark.recordings
def test_recordings_at_hand_join_what_ships_if_they_have_a_body(tmp_path, monkeypatch):
    folder = tmp_path / "sequences"
    folder.mkdir()
    mesh = {"garment_V": np.zeros((2, 3, 3)), "garment_F": np.array([[0, 1, 2]]), "fps": 30.0}
    np.savez(folder / "sim_skirt_hop.npz", **mesh, body_V=np.zeros((2, 3, 3)), body_F=np.array([[0, 1, 2]]))
    np.savez(folder / "bare_dress.npz", **mesh)
    monkeypatch.setenv("DDAKF_DATA", str(tmp_path))
    found = {source.labels.name: source for source in sources()}
    assert found["sim_skirt_hop"].external
    assert (found["sim_skirt_hop"].labels.garment, found["sim_skirt_hop"].labels.motion) == ("skirt", "hop")
    assert not found["sample"].external
    assert "bare_dress" not in found
    monkeypatch.delenv("DDAKF_DATA")
    assert not any(source.external for source in sources())


@pytest.mark.recordings
def test_rehearsals_are_left_out_by_garment_and_motion(monkeypatch):
    monkeypatch.delenv("DDAKF_DATA", raising=False)
    left = without_scored(RecordingLabels("mine", "T-shirt", "jump"), sources())
    rehearsed = {source.origin[:2] for source in left if isinstance(source.origin, Rehearsal)}
    assert len(rehearsed) == 3 * 6
    assert not {pair for pair in rehearsed if pair[0] == "tshirt" or pair[1] == "jump"}
    assert data.SAMPLE not in {source.origin for source in left}


def test_digests_tell_files_and_rehearsals_apart(tmp_path):
    (tmp_path / "a").write_bytes(b"a")
    (tmp_path / "b").write_bytes(b"b")
    made_from = tmp_path / "a", tmp_path / "b", Rehearsal("skirt", "walk", 1, 2), Rehearsal("skirt", "walk", 1, 3)
    assert len({Source(RecordingLabels(), what).digest for what in made_from}) == 4

"""What is scored is not learned from: neither it, nor its garment, nor its motion."""

import numpy as np

from ddakf import data
from ddakf.evaluation.baselines import NOTHING_SAID, Scored
from ddakf.evaluation.baselines.clothfit.library import Source, allowed, sources

SOURCES = [
    Source(Scored(*labels), data.SAMPLE, True)
    for labels in (("a", "skirt", "jump"), ("b", "skirt", "dance"), ("c", "tank top", "jump"), ("d", "tank top", "walk"))
]


def names(kept):
    return [source.scored.name for source in kept]


def test_name_garment_and_motion_are_left_out():
    assert names(allowed(Scored("a", "skirt", "jump"), SOURCES)) == ["d"]
    assert names(allowed(Scored("other", "", "jump"), SOURCES)) == ["b", "d"]
    assert names(allowed(Scored("d"), SOURCES)) == ["a", "b", "c"]


def test_nothing_said_leaves_nothing_out():
    assert names(allowed(NOTHING_SAID, [*SOURCES, Source(Scored("", "", ""), data.SAMPLE, True)])) == ["a", "b", "c", "d", ""]


def test_recordings_at_hand_join_what_ships_if_they_have_a_body(tmp_path, monkeypatch):
    folder = tmp_path / "sequences"
    folder.mkdir()
    mesh = {"garment_V": np.zeros((2, 3, 3)), "garment_F": np.array([[0, 1, 2]]), "fps": 30.0}
    np.savez(folder / "sim_skirt_hop.npz", **mesh, body_V=np.zeros((2, 3, 3)), body_F=np.array([[0, 1, 2]]))
    np.savez(folder / "bare_dress.npz", **mesh)
    monkeypatch.setenv("DDAKF_DATA", str(tmp_path))
    found = {source.scored.name: source for source in sources()}
    assert not found["sim_skirt_hop"].shipped
    assert (found["sim_skirt_hop"].scored.garment, found["sim_skirt_hop"].scored.motion) == ("skirt", "hop")
    assert found["sample"].shipped
    assert "bare_dress" not in found
    monkeypatch.delenv("DDAKF_DATA")
    assert all(source.shipped for source in sources())

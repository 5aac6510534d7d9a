"""Splits: categories and motions by name, and no overlap of training and test."""

import numpy as np
import pytest

from ddakf import data
from ddakf.data import sample
from ddakf.errors import InvalidFile
from ddakf.evaluation.splits import faust_split, labels_of, labels_of_file, unit_of
from ddakf.files.sequence import Sequence

NAMES = ("sample", "pergamo_005", "samba_dress", "samba_whole", "sim_skirt_dance", "sim_tank_move", "sim_tshirt_jump")
CLIPS = tuple(f"s{subject}_p{pose}" for subject in (0, 3, 7, 8, 9) for pose in (1, 2))


@pytest.mark.parametrize(
    ("name", "garment", "motion"),
    [
        ("sample", "T-shirt", "sample"),
        ("pergamo_005", "T-shirt", "pergamo_005"),
        ("samba_dress", "dress", "samba"),
        ("samba_whole", "whole body", "samba"),
        ("sim_skirt_dance", "skirt", "dance"),
        ("sim_tank_move", "tank top", "move"),
        ("sim_tshirt_crossed_arms", "T-shirt", "crossed_arms"),
        ("tshirt", "T-shirt", "tshirt"),
        ("00042_Tshirt", "T-shirt", "00042"),
        ("00042_Top", "tank top", "00042"),
        ("faust_s3_p7", "whole body", "p7"),
        ("scarf_wind", "scarf_wind", "scarf_wind"),
    ],
)
def test_a_name_says_garment_and_motion(name, garment, motion):
    assert labels_of(name) == (name, garment, motion)


def test_a_sequence_is_scored_by_its_name():
    assert labels_of(sample()) == labels_of("sample")


@pytest.mark.parametrize(
    ("said", "garment", "motion"),
    [
        (("tshirt", "walk"), "T-shirt", "walk"),
        (("tshirt", "crossed-arms"), "T-shirt", "crossed_arms"),
        (("Silk scarf", ""), "silk_scarf", "dance"),
        (("", "hop"), "skirt", "hop"),
        (("", ""), "skirt", "dance"),
    ],
)
def test_what_a_sequence_says_comes_before_its_name(tmp_path, said, garment, motion):
    vertices, faces, path = np.zeros((2, 3, 3)), np.array([[0, 1, 2]]), tmp_path / "sim_skirt_dance.npz"
    assert labels_of(Sequence(path.stem, vertices, faces, 30.0, None, None, None, *said)) == (path.stem, garment, motion)
    np.savez(path, garment_V=vertices, garment_F=faces, fps=30.0, **dict(zip(("garment", "motion"), said, strict=True)))
    assert labels_of_file(path) == (path.stem, garment, motion)


def test_what_ships_says_what_its_name_says():
    for path in (data.SAMPLE, *data.TRAINING.glob("*.npz")):
        assert labels_of_file(path) == labels_of(path.stem)


def test_a_file_whose_garment_is_no_word_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", garment=np.arange(3))
    with pytest.raises(InvalidFile, match=r"a\.npz: garment: expected one word, got int64 of shape \(3,\)"):
        labels_of_file(tmp_path / "a.npz")


def test_a_recording_at_another_rate_is_the_same_unit():
    assert unit_of("sample@60") == unit_of("sample") == "sample"
    assert unit_of("scan@home.npz") == "scan@home.npz"
    assert unit_of("faust_s3_p7@60") == unit_of("faust_s3_p1") == "FAUST, subject 3"


def test_faust_is_parted_as_in_the_paper():
    split = faust_split(CLIPS)
    assert split.train == ("s0_p1", "s0_p2", "s3_p1", "s3_p2", "s7_p1", "s7_p2")
    assert split.test == ("s8_p1", "s8_p2", "s9_p1", "s9_p2")
    assert faust_split(CLIPS[:4]).test == ()

"""The training recordings that ship: complete, within the quality limits, and as in their README."""

import json
import re

import numpy as np
import pytest

from ddakf import data
from ddakf.data.body import load_body
from ddakf.evaluation.baselines.clothfit import library
from ddakf.evaluation.simulation import motions, quality
from ddakf.files.sequence import load_sequence
from tests.lanes import every

PATHS = sorted(data.TRAINING.glob("*.npz"))


def test_there_is_a_mixture_of_four_garments_and_four_motions_and_it_is_small():
    sequences = data.training()
    assert {sequence.garment for sequence in sequences} == {"tshirt", "tank", "skirt", "dress"}
    assert len({sequence.motion for sequence in sequences} & set(motions.MOTIONS)) >= 4
    assert sum(path.stat().st_size for path in PATHS) < 6e6


@pytest.mark.parametrize("path", every(4, PATHS), ids=lambda path: path.stem)
def test_a_recording_is_fit_for_use_and_as_its_note_says(path):
    sequence = load_sequence(path)
    assert path.stem == f"{sequence.garment}_{sequence.motion}"
    assert np.abs(sequence.body_vertices[0] - load_body().vertices).max() < 1e-4
    found, note = quality.figures(sequence), json.loads(path.with_suffix(".json").read_text())["quality"]
    quality.check(found)
    assert found["stretch_p99"] == pytest.approx(note["stretch_p99"], abs=2e-3)
    assert found["displacement_mean_mm"] == pytest.approx(note["displacement_mean_mm"], abs=0.05)


def test_the_readme_lists_them_with_their_figures():
    rows = re.findall(
        r"^\| `(\w[\w-]*)` \| (\d+) \| (\d+) \| ([\d.]+) \| ([\d.]+) \|", (data.TRAINING / "README.md").read_text(), re.M
    )
    expected = []
    for path in PATHS:
        note = json.loads(path.with_suffix(".json").read_text())["quality"]
        numbers = f"{note['stretch_p99']:.3f}", f"{note['displacement_mean_mm']:.1f}"
        expected.append((path.stem, str(note["vertices"]), str(note["frames"]), *numbers))
    assert sorted(rows) == expected


@pytest.mark.recordings
def test_clothfit_may_learn_from_all_of_them():
    assert set(PATHS) <= {source.origin for source in library.sources() if not source.external}

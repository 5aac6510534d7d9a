"""The baselines' defaults are the ones that the recorded search chose, and the document shows its results."""

import json
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path

import pytest

from ddakf.evaluation.datasets import collection
from ddakf.evaluation.paper_scope import CONDITIONS

ROOT = Path(__file__).parents[2]
REPORT = json.loads((ROOT / "benchmarks/results/tuning.json").read_text())


@pytest.fixture(scope="module")
def tuning():
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        import tuning
    finally:
        sys.path.remove(str(ROOT / "benchmarks"))
    return tuning


def test_every_baseline_was_searched_over_its_axes(tuning):
    assert set(REPORT["methods"]) == set(tuning.NAMES)
    for name, (_, _, axes, _) in tuning.SEARCHES.items():
        tries = [row["settings"] for row in REPORT["methods"][name]["tries"]]
        assert len(tries) >= 1 + sum(len(values) - 1 for values in axes.values())
        for axis, values in axes.items():
            assert {row[axis] for row in tries} >= set(values), (name, axis)


def test_no_chosen_value_is_at_the_end_of_its_axis_but_at_a_limit(tuning):
    for name, (_, _, axes, shown) in tuning.SEARCHES.items():
        if shown is tuning.learned_clips:
            continue  # searched over fixed values
        method = REPORT["methods"][name]
        for axis in axes:
            tried, best = {row["settings"][axis] for row in method["tries"]}, method["chosen"][axis]
            new = tuning.wider(axis, tried, best)
            assert new is None or new in tried or _often_widened(axes[axis], tried, tuning.WIDENINGS), (name, axis)


def _often_widened(first, tried, most):
    return len(tried) >= len(first) + most


def test_an_axis_is_widened_by_its_last_ratio_up_to_a_limit(tuning):
    assert tuning.wider("gate", (0.05, 0.1, 0.2), 0.2) == 0.4
    assert tuning.wider("gate", (0.05, 0.1, 0.2), 0.05) == 0.025
    assert tuning.wider("gate", (0.05, 0.1, 0.2), 0.1) is None
    assert tuning.wider("harmonics", (12, 24, 48), 48) == 96
    assert tuning.wider("harmonics", (12, 24, 48, 96), 96) == 96, "a limit"
    assert tuning.wider("facing", (True, False), True) is None


def test_the_defaults_are_the_chosen_settings(tuning):
    for name, (_, settings, _, _) in tuning.SEARCHES.items():
        assert asdict(settings()) == REPORT["methods"][name]["chosen"], name


def test_what_was_chosen_has_the_least_error_of_all_tries(tuning):
    for name in tuning.SEARCHES:
        method = REPORT["methods"][name]
        assert method["score"]["rmse_mm"] == min(row["rmse_mm"] for row in method["tries"])
        assert method["score"]["settings"].items() <= method["chosen"].items()


def test_the_document_names_the_learned_methods_settings_and_error():
    text = " ".join((ROOT / "docs/baselines.md").read_text().split())
    learned = REPORT["methods"]["clothfit"]
    assert "*gate* (change needed before still vectors count) {gate:g}, ".format(**learned["chosen"]) in text
    assert "(reduction by spread) {caution:g}, rounds of *smoothing* {smoothing}, ".format(**learned["chosen"]) in text
    best = min(learned["tries"], key=lambda row: row["rmse_mm"])
    assert f"{best['rmse_mm']:.2f} / {best['normal_rmse_mm']:.2f} mm" in text


@pytest.mark.recordings
def test_the_learned_method_is_tuned_on_nothing_that_is_scored(tuning, monkeypatch):
    asked = []
    monkeypatch.setattr(tuning.weights, "committee", lambda *of: asked.append(of))
    shown = list(tuning.learned_clips(2))
    names = [clip.name for clip in shown]
    assert names == REPORT["meta"]["learned_clips"] == list(REPORT["methods"]["clothfit"]["score"]["clips"])
    for clip in shown:
        tuning.clothfit(tuning.AnswerSettings(), clip.labels).start(clip.garment, clip.start, clip.body)
    assert [scored.name for scored, _, _ in asked] == names
    for _, _, among in asked:
        assert {source.labels.name for source in among} >= set(names)
        assert not any(source.external or source.origin == tuning.data.SAMPLE for source in among)


def test_a_search_keeps_the_best_value_of_every_axis(tuning, monkeypatch):
    from ddakf.evaluation.baselines.filters.kalman_filter import KalmanFilter, KalmanSettings

    def score(make, shown):
        settings = make(next(shown)).args[0].settings
        return {"rmse_mm": abs(settings.gate - 0.2) + abs(settings.measurement_sd - 0.3), "normal_rmse_mm": 0.0}

    axes = {"gate": (0.05, 0.2, 0.3), "measurement_sd": (0.1, 0.3), "normal_cosine": (0.5, 0.0)}
    search = tuning.Search(tuning.without_labels(KalmanFilter), KalmanSettings, axes, tuning.learned_clips)
    monkeypatch.setitem(tuning.SEARCHES, "kf", search)
    monkeypatch.setattr(tuning, "score", score)
    found = tuning.search("kf", 3)
    assert found["chosen"] == asdict(KalmanSettings(gate=0.2, measurement_sd=0.3, normal_cosine=0.5))
    assert len(found["tries"]) == 6, "the best of the second axis is at its end: one try beyond"


def test_the_score_is_the_error_of_a_method_that_stands_still(tuning):
    class Still:
        def start(self, garment, vertices, body):
            self.vertices = vertices

        def step(self, frame):
            return self.vertices

    row = tuning.score(lambda clip: partial(tuning.start_baseline, Still()), tuning.clips(2))
    clip = next(tuning.clips(2))
    moved = [tuning.metrics.rmse_mm(clip.start, frame.truth) for frame in clip.frames]
    assert row["clips"][clip.name]["rmse_mm"] == pytest.approx(sum(moved) / 2, abs=0.006)


def test_settings_are_chosen_on_training_recordings_in_every_condition(tuning):
    training = {each.name for each in collection.listed(collection.TRAINING)}
    assert {name for name, _ in tuning.CLIPS} <= training
    assert {view for _, view in tuning.CLIPS} == set(CONDITIONS)

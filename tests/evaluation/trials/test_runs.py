"""Runs of trials: reproducible rows, and pools equal to those of one run."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ddakf import Config
from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics
from ddakf.evaluation.baselines.nicp import NonRigidIcp
from ddakf.evaluation.metrics import calibration
from ddakf.evaluation.sensors.degradations import DISTURBANCES
from ddakf.evaluation.trials import accuracy_tables, calibration_pools, methods, recordings, run_score, runs
from ddakf.evaluation.trials.methods import BASELINES
from ddakf.evaluation.trials.trial import Trial
from ddakf.evaluation.trials.variants import ablations, refinements

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
SHORT = Trial("sample", frames=4, points=3000)
TIMES = {"seconds", "cpu_ms_p50", "cpu_ms_p99", "wall_ms_p50", "wall_ms_p99", "fps"}


@pytest.fixture(scope="module")
def rows():
    front = replace(SHORT, view="front", body=True)
    wanted = SHORT, replace(SHORT, variant="nicp"), front, replace(front, variant="no-carrying"), replace(front, seed=2)
    return [json.loads(json.dumps(runs.run_trial(trial))) for trial in wanted]


def test_a_row_holds_the_trial_and_its_numbers(rows):
    row = rows[2]
    assert (row["sequence"], row["view"], row["body"], row["seed"], row["variant"]) == ("sample", "front", True, 1, "default")
    assert row["frames_tracked"] == 4
    assert row["per_frame"]["number"] == [1, 2, 3, 4]
    assert 0 < row["normal_rmse_mm"] < row["rmse_mm"] < 30
    assert row["rmse_mm"] == pytest.approx(np.mean(row["per_frame"]["rmse_mm"]), rel=1e-4)
    assert row["observed"]["n"] + row["hidden"]["n"] == 4 * 2658
    assert sum(row["states"].values()) == 4 == len(row["per_frame"]["state"])
    for name in ("reliability", "paper_score", "coverage", "penetration_mm", "coverage90"):
        assert len(row["per_frame"][name]) == 4
    for group in ("observed", "hidden"):
        assert np.all(np.diff(row[group]["inside"]) >= 0)
        at_90 = row[group]["inside"][calibration.NOMINAL_PROBABILITIES.index(0.9)]
        assert at_90 == pytest.approx(row[group]["coverage90"], abs=1e-3)


def test_a_baseline_has_errors_but_no_uncertainty(rows):
    row = rows[1]
    assert 0 < row["normal_rmse_mm"] < row["rmse_mm"] < 30
    assert row["observed"] is None
    assert row["states"] == {}


def test_the_same_trial_gives_the_same_row(rows):
    again = json.loads(json.dumps(runs.run_trial(SHORT)))
    assert {k: v for k, v in again.items() if k not in TIMES} == {k: v for k, v in rows[0].items() if k not in TIMES}


def test_a_row_knows_its_trial(rows):
    assert Trial.from_row(rows[0]) == SHORT
    assert Trial.from_row({"sequence": "sample", "view": "front"}) == Trial("sample", "front")


def test_every_ablation_differs_from_the_default_where_its_name_says():
    default = Config().to_dict()
    stages = {
        "no-planes": {"associate"}, "one-association": {"associate", "coarse"}, "no-visibility": {"associate"},
        "no-correlation": {"physics"}, "no-carrying": {"predict"},
        "no-softening": {"physics"}, "no-clusters": {"coarse"}, "no-hems": {"associate"}, "no-holding": {"anchor"},
        "no-weight": {"physics"}, "no-following": {"follow"},
    }  # fmt: skip
    variants = ablations() | refinements()
    assert {name: {s for s in default if c.to_dict()[s] != default[s]} for name, c in variants.items()} == stages


def test_variants_by_name_and_by_json():
    assert methods.configuration("default") == Config()
    assert methods.configuration("paper") == Config.paper()
    assert methods.configuration('eager={"associate": {"iterations": 3}}').associate.iterations == 3
    for wrong in ("magic", "x={", 'x={"associate": {"pace": 3}}'):
        with pytest.raises(InvalidArgument):
            methods.configuration(wrong)


@pytest.mark.recordings
def test_what_there_is_not_is_named_and_no_row():
    for name in ("sequence", "view", "variant"):
        with pytest.raises(InvalidArgument, match="nowhere"):
            runs.run_trial(replace(SHORT, **{name: "nowhere"}))


def test_what_a_method_cannot_do_is_a_row_that_says_so(monkeypatch, rows):
    class Breaks(NonRigidIcp):
        def step(self, frame):
            raise np.linalg.LinAlgError("singular matrix")

    monkeypatch.setitem(BASELINES, "breaks", lambda scored: Breaks())
    row = runs.run_trial(replace(SHORT, variant="breaks"))
    assert row["failed"] == "LinAlgError: singular matrix"
    assert "breaks: LinAlgError: singular matrix" in accuracy_tables.report([*rows, row])
    assert "failed" in accuracy_tables.ablation([*rows, row])


def test_a_start_astray_is_a_rigid_motion_by_ten_centimetres_and_twenty_degrees():
    sequence = recordings.find_recording("sample")
    rest, truth = sequence.garment_rest.astype(float), sequence.garment_vertices[60].astype(float)
    for number in range(4):
        start = runs.displaced_template(rest, truth, number)
        shift = start.mean(axis=0) - truth.mean(axis=0)
        assert np.linalg.norm(shift) == pytest.approx(0.1)
        assert shift[1] == pytest.approx(0, abs=1e-9)
        edges = start[sequence.garment_faces[:, 0]] - start[sequence.garment_faces[:, 1]]
        rest_edges = rest[sequence.garment_faces[:, 0]] - rest[sequence.garment_faces[:, 1]]
        assert np.allclose(np.linalg.norm(edges, axis=1), np.linalg.norm(rest_edges, axis=1))
    own = runs.displaced_template(truth, truth, 0) - runs.displaced_template(truth, truth, 0).mean(axis=0)
    centred = truth - truth.mean(axis=0)
    cosine = (own[:, [0, 2]] * centred[:, [0, 2]]).sum() / (centred[:, [0, 2]] ** 2).sum()
    assert cosine == pytest.approx(np.cos(np.radians(20)))


def test_a_start_is_compared_with_the_run_from_the_truth():
    row = runs.run_trial(replace(SHORT, start=0, first=30, frames=3))
    assert row["per_frame"]["number"] == [31, 32, 33]
    assert row["reference_rmse_mm"] == runs.run_trial(replace(SHORT, first=30, frames=3))["per_frame"]["rmse_mm"]
    assert row["per_frame"]["rmse_mm"][0] != row["reference_rmse_mm"][0], "another start"
    assert accuracy_tables.success(row | {"frames_until_normal_rmse_mm": 15, "frames_until_rmse_mm": 15})
    assert not accuracy_tables.success(row | {"frames_until_normal_rmse_mm": 15, "frames_until_rmse_mm": None})
    skirt = row | {"sequence": "sim_skirt_dance", "frames_until_normal_rmse_mm": 15, "frames_until_rmse_mm": 16}
    assert accuracy_tables.success(skirt)


def test_a_disturbed_run_is_compared_with_the_undisturbed_one():
    gap, missing = (script.name for script in DISTURBANCES[:2])
    calm = runs.run_trial(replace(SHORT, frames=52))["per_frame"]["rmse_mm"]
    for name, numbers in ((gap, [*range(1, 31), *range(46, 53)]), (missing, list(range(1, 53)))):
        row = runs.run_trial(replace(SHORT, frames=52, disturbance=name))
        per_frame = row["per_frame"]
        assert per_frame["number"] == numbers
        assert row["reference_rmse_mm"] == [calm[number - 1] for number in numbers]
        assert per_frame["rmse_mm"][:30] == calm[:30], "until then nothing has happened"
        assert per_frame["rmse_mm"][30] != calm[numbers[30] - 1]
        ratio = np.divide(per_frame["rmse_mm"], row["reference_rmse_mm"])
        after = numbers.index(46 if name == gap else 51)
        assert row["frames_until_rmse_mm"] == metrics.frames_until_within(ratio[after:], np.ones(52 - numbers[after] + 1), 1.5)
    assert "| default | " + missing in accuracy_tables.report([row])
    with pytest.raises(InvalidArgument, match="disturbance"):
        runs.run_trial(replace(SHORT, disturbance="an earthquake"))


def test_unsegmented_points_are_compared_with_the_garments_own(rows):
    person = json.loads(json.dumps(runs.run_trial(replace(SHORT, view="front", body=True, segmented=False))))
    line = accuracy_tables.unsegmented([rows[2], person]).splitlines()[-1]
    assert line.startswith("| sample | front+body |")
    own = accuracy_tables.calibration(rows)
    assert accuracy_tables.calibration([*rows, person]) == own, "points of the whole person are another task"
    assert float(line.split("|")[-2]) == pytest.approx(person["rmse_mm"] / rows[2]["rmse_mm"], abs=0.006)


def test_pooling_two_runs_is_as_if_they_were_one():
    rng = np.random.default_rng(0)
    whole, parts = run_score.CalibrationSums(), [run_score.CalibrationSums(), run_score.CalibrationSums()]
    for part, n in zip(parts, (10, 30), strict=True):
        error, nll = rng.normal(size=(n, 3)) * 0.01, rng.normal(size=n)
        m = (error**2).sum(axis=1) / 1e-4
        for target in (whole, part):
            target.add(error, 0 * error, m, nll)
    rows = [{"body": False, "observed": part.summary(), "hidden": None} for part in parts]
    pool = calibration_pools.pooled(rows)["observed"]
    expected = whole.summary()
    assert pool["n"] == 40
    for name in ("coverage90", "nees3", "nll", "inside", "nll_constant"):
        assert pool[name] == pytest.approx(expected[name])


def test_calibration_is_of_all_of_each_view_and_of_each_recording(rows):
    other = [row | {"sequence": "another"} for row in rows]
    assert {part["runs"] for part in calibration_pools.calibrated([*rows, *other])} >= {"all", "another", "sample", "full"}
    assert "sample" not in {part["runs"] for part in calibration_pools.calibrated(rows)}


def test_tables_hold_every_run(rows):
    text = accuracy_tables.report(rows)
    assert "| sample | full | 1 |" in text
    assert "| sample | front+body | 2 |" in text
    assert " ± " in text
    widths = {line.count("|") for line in accuracy_tables.accuracy(rows).splitlines()}
    assert len(widths) == 1, "every line has as many cells as the head"
    variants = {line.split("|")[3].strip() for line in accuracy_tables.shape(rows).splitlines()[2:]}
    assert variants == {"default", "nicp", "no-carrying"}
    assert "no-carrying" in accuracy_tables.ablation(rows)
    assert "hidden, body given" in accuracy_tables.calibration(rows)
    assert {run["variant"] for run in accuracy_tables.summary(rows)["runs"]} == {"default", "nicp", "no-carrying"}


def test_the_reliability_diagram_is_a_picture(rows, tmp_path):
    pytest.importorskip("matplotlib")
    from ddakf.evaluation.drawing.diagrams import reliability_diagram

    curves = calibration_pools.reliability_curves(rows)
    assert "observed" in curves
    reliability_diagram(tmp_path / "new/reliability.png", curves)
    assert (tmp_path / "new/reliability.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InvalidArgument):
        reliability_diagram(tmp_path / "none.png", {})


def test_the_command_goes_on_where_it_ended(tmp_path):
    command = [sys.executable, ROOT / "benchmarks/accuracy.py", "--sequences", "sample", "--frames", "2", "--points", "2000",
               "--out", tmp_path / "rows.jsonl"]  # fmt: skip

    def call(*more):
        ended = subprocess.run([*command, *more], capture_output=True, text=True, timeout=250, check=False)
        assert ended.returncode == 0, ended.stderr
        return ended

    call("--variants", "default", "nicp")
    assert "2 of 3 runs are in" in call("--variants", "default", "nicp", "one-association").stderr
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == 3
    assert "one-association" in call("--table").stdout
    call("--summary", tmp_path / "summary.json")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [run["variant"] for run in summary["runs"]] == ["default", "nicp", "one-association"]
    assert summary["machine"]["cpu"]

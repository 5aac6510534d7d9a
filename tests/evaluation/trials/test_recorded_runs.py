"""Recorded runs without vertex truth: scores by hand, of methods with known errors."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ddakf import data
from ddakf.errors import InvalidArgument
from ddakf.evaluation.datasets import Pair
from ddakf.evaluation.sensors.captured_frame import Cloud
from ddakf.evaluation.sensors.virtual_sensor import Sensor
from ddakf.evaluation.studies import paper_studies
from ddakf.evaluation.trials import recordings
from ddakf.evaluation.trials.estimates import FrameEstimate
from ddakf.evaluation.trials.recorded_runs import pair_row, recording_row
from ddakf.evaluation.trials.trial import PAIR_STEPS
from ddakf.mesh import Mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
MESH = Mesh(SQUARE, np.array([[0, 1, 2], [0, 2, 3]]))
UP = np.array([0.0, 0.0, 0.01])  # m per frame
POINTS = np.random.default_rng(0).uniform([0.1, 0.1, 0], [0.9, 0.9, 0], (200, 3))


class Rising:
    """A square that rises by 10 mm per frame, 10 frames per second."""

    name, fps = "rising", 10.0

    def __len__(self):
        return 6

    def timestamp(self, frame):
        return frame / self.fps

    def cloud(self, frame):
        return Cloud((POINTS + frame * UP).astype(np.float32), np.zeros(3))

    def template(self, frame=0):
        return Mesh(SQUARE + frame * UP, MESH.faces)


def method(vertices_of, seen=None):
    """Makes what says that the vertices are ``vertices_of(start, frame)``."""

    def make(garment, start, body):
        assert body is None

        def step(frame):
            if seen is not None:
                seen.append(frame)
            return FrameEstimate(vertices_of(start, frame))

        return step

    return make


FROZEN = method(lambda start, frame: start)


def test_who_follows_has_no_residual_and_who_stands_still_has_the_motion():
    followed = recording_row(method(lambda start, frame: SQUARE + frame.number * UP), Rising(), range(1, 6), Sensor(), 1)
    assert followed["frames_tracked"] == 5
    assert followed["residual_mm"] == pytest.approx(0, abs=1e-4)
    assert followed["own_flicker_mm"] == pytest.approx(0, abs=1e-3)
    frozen = recording_row(FROZEN, Rising(), range(3, 6), Sensor(), 1)  # the template is of frame 2
    assert frozen["per_frame"]["residual_mm"] == pytest.approx([10, 20, 30], rel=1e-5)
    assert frozen["residual_mm"] == frozen["residual_p95_mm"] == pytest.approx(20, rel=1e-5)
    still = {"residual_mm": frozen["residual_mm"], "stretch_pct": 0, "own_flicker_mm": 0}
    assert frozen["clips"] == [{"first": 3, "frames": 3} | still]


def test_what_a_method_does_to_its_input_or_its_answer_later_does_not_count():
    def centring(garment, start, body):
        answer = np.array(start)

        def step(frame):
            answer[:] = start + frame.number * UP
            frame.points[:] -= frame.points.mean(axis=0)
            return FrameEstimate(answer)

        return step

    kept = recording_row(method(lambda start, frame: start + frame.number * UP), Rising(), range(1, 5), Sensor(), 1)
    changing = recording_row(centring, Rising(), range(1, 5), Sensor(), 1)
    for name in ("residual_mm", "own_flicker_mm", "drift_mm"):
        assert changing[name] == kept[name]
    target = Cloud(POINTS.astype(np.float32), np.zeros(3))
    pair_row(centring, Pair("pair", MESH, SQUARE[:2], np.zeros((2, 3)), target, 2.0))
    assert np.array_equal(target.points, POINTS.astype(np.float32))


def test_an_estimate_that_is_not_finite_fails_the_run():
    torn = method(lambda start, frame: start * (np.nan if frame.number == 2 else 1.0))
    with pytest.raises(ArithmeticError, match="not finite in frame 2"):
        recording_row(torn, Rising(), range(1, 5), Sensor(), 1)


def test_a_mesh_torn_to_the_points_is_betrayed_by_its_stretch():
    torn = recording_row(method(lambda start, frame: 2 * SQUARE + frame.number * UP), Rising(), range(1, 6), Sensor(), 1)
    assert torn["residual_mm"] == pytest.approx(0, abs=1e-4)
    assert torn["stretch_pct"] == pytest.approx(100)


def test_the_frames_are_the_sensors_without_further_noise():
    seen = []
    recording_row(method(lambda start, frame: start, seen), Rising(), range(2, 6, 2), Sensor(points=50, noise=0.5, every=2), 1)
    assert [frame.number for frame in seen] == [2, 4, 2, 0]  # there and back again
    assert [frame.timestamp for frame in seen] == pytest.approx([0.2, 0.4, 0.6, 0.8])
    for frame in seen:
        assert frame.points.shape == (50, 3)
        assert frame.points[:, 2] == pytest.approx(0.01 * frame.number)


def test_errors_of_a_virtual_camera_are_refused_and_not_passed_over():
    with pytest.raises(InvalidArgument, match="fliers: expected 0 for a recording"):
        recording_row(FROZEN, Rising(), range(1, 4), Sensor(fliers=0.1), 1)


def test_the_end_point_error_of_a_pair_is_of_the_last_of_its_steps():
    shift = np.array([0.3, 0.0, 0.4])
    points = SQUARE.mean(axis=0) + np.array([[0.1, 0, 0], [0, 0.2, 0]])
    pair = Pair("pair", MESH, points, np.tile(shift, (2, 1)), Cloud((POINTS + shift).astype(np.float32), np.zeros(3)), 2.0)
    seen = []
    gradual = pair_row(method(lambda start, frame: start + min(frame.number / 5, 1) * shift, seen), pair)
    errors = [400, 300, 200, 100] + [0] * (PAIR_STEPS - 4)
    assert gradual["per_frame"]["end_point_error_mm"] == pytest.approx(errors, abs=1e-6)
    assert (gradual["end_point_error_mm"], gradual["within_5cm"]) == (pytest.approx(0, abs=1e-6), 1)
    assert (gradual["residual_mm"], gradual["stretch_pct"]) == pytest.approx((0, 0), abs=1e-4)
    assert [frame.timestamp for frame in seen] == pytest.approx([2.0 * k / PAIR_STEPS for k in range(1, PAIR_STEPS + 1)])
    still = pair_row(FROZEN, pair)
    assert (still["end_point_error_mm"], still["within_5cm"]) == (pytest.approx(500), 0)


@pytest.mark.slow
@pytest.mark.recordings
def test_the_frames_of_a_study_are_those_of_recordings_too(monkeypatch):
    monkeypatch.setattr(paper_studies, "depth_recording_names", lambda: (["a.mat", "b.mat"], []))
    plan = paper_studies.studies(replace(paper_studies.FULL, frames="0:12", faust=0))["depth"]
    assert (plan.sequences, plan.frames) == (("a.mat", "b.mat"), "0:12")


@pytest.mark.recordings
def test_recordings_under_the_data_folder_are_named_without_it(monkeypatch, tmp_path):
    """Results name the same recording alike on every machine."""
    monkeypatch.setenv("DDAKF_DATA", str(tmp_path))
    (tmp_path / "depth/utd-mhad").mkdir(parents=True)
    (tmp_path / "depth/utd-mhad/a1_depth.mat").touch()
    (tmp_path / "depth/deepdeform/seq1").mkdir(parents=True)
    assert recordings.depth_recording_names() == (["depth/utd-mhad/a1_depth.mat"], ["depth/deepdeform/seq1"])
    shutil.copy(next(data.TRAINING.glob("*.npz")), tmp_path / "depth/mine.npz")
    assert len(recordings.find_recording("depth/mine.npz")) > 1


def test_results_that_ship_name_no_folder_of_a_machine():
    root = Path(__file__).parents[3]
    for path in (*root.glob("results/*.json"), *root.glob("benchmarks/results/*.json")):
        assert not re.search(r"/(work|root|home|tmp|Users)/", path.read_text()), path.name

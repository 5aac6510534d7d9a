"""Quality figures of a recording made by hand: a sheet over a box, stretched, pushed in, moved by known amounts."""

import numpy as np
import pytest

from ddakf.errors import PoorQuality
from ddakf.evaluation.simulation import quality
from ddakf.files.sequence import Sequence

SHEET = np.array([[-0.2, 0, -0.2], [0.2, 0, -0.2], [0.2, 0, 0.2], [-0.2, 0, 0.2]], np.float32)
SHEET_FACES = np.array([[0, 2, 1], [0, 3, 2]])
BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 0) for z in (-1, 1)], np.float32)
BOX_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip


def recording(*frames):
    """A sheet over the box's lid, which is at y = 0, in the given frames (V, 3); its rest shape 10 mm above."""
    rest = SHEET + [0, 0.01, 0]
    body = np.repeat(BOX[None], len(frames), axis=0)
    return Sequence("made", np.array(frames, np.float32), SHEET_FACES, 30.0, rest.astype(np.float32), body, BOX_FACES)


def test_a_recording_at_rest_has_no_stretch_no_depth_and_no_motion():
    found = quality.figures(recording(SHEET + [0, 0.01, 0], SHEET + [0, 0.01, 0]))
    assert found["stretch_mean"] == found["stretch_max"] == 1
    assert found["penetration_max_mm"] == found["inside_share_mean"] == found["displacement_max_mm"] == 0
    assert (found["vertices"], found["faces"], found["frames"], found["finite"]) == (4, 2, 2, True)
    quality.check(found)


def test_stretch_is_the_ratio_of_lengths():
    wide = SHEET * [1.1, 1, 1.1] + [0, 0.01, 0]
    found = quality.figures(recording(SHEET + [0, 0.01, 0], wide))
    assert found["stretch_max"] == pytest.approx(1.1, abs=1e-4)
    assert found["stretch_mean"] == pytest.approx(1.05, abs=1e-4)
    assert found["stretch_worst_frame_p99"] == pytest.approx(1.1, abs=1e-4)


def test_depth_and_displacement_are_in_millimetres():
    sunk = SHEET + np.array([[0, 0.01, 0], [0, -0.004, 0], [0, 0.01, 0], [0, 0.01, 0]])
    found = quality.figures(recording(SHEET + [0, 0.01, 0], sunk))
    assert found["penetration_max_mm"] == found["penetration_mean_mm"] == pytest.approx(4, abs=1e-3)
    assert found["inside_share_mean"] == 1 / 8
    assert found["inside_share_max"] == 1 / 4
    assert found["faces_inside_share_mean"] == 0  # the centres of both faces are still above the lid
    assert found["displacement_max_mm"] == pytest.approx(14, abs=1e-3)
    assert found["displacement_mean_mm"] == pytest.approx(14 / 4, abs=1e-3)


def test_a_face_is_inside_when_its_centre_is():
    raised = SHEET + np.array([[0, -0.03, 0], [0, 0.01, 0], [0, 0.01, 0], [0, 0.01, 0]])  # corner 0 is in both faces
    assert quality.figures(recording(SHEET + [0, 0.01, 0], raised))["faces_inside_share_mean"] == 0.5


@pytest.mark.parametrize(
    ("frame", "named"),
    [
        (SHEET * [1.5, 1, 1.5] + [0, 0.01, 0], "stretch_p99 is 1.5"),
        (SHEET - [0, 0.02, 0], "inside_share_mean is 0.5"),
        (SHEET + [0, 0.5, 0], "displacement_max_mm is 490"),
    ],
)
def test_a_bad_recording_is_refused_with_a_sentence_that_names_the_figure(frame, named):
    with pytest.raises(PoorQuality, match=named):
        quality.check(quality.figures(recording(SHEET + [0, 0.01, 0], frame)))


def test_a_solver_that_diverged_is_named_as_such():
    broken = SHEET.copy()
    broken[0] = np.nan
    with pytest.raises(PoorQuality, match="not finite"):
        quality.check(quality.figures(recording(SHEET, broken)))
